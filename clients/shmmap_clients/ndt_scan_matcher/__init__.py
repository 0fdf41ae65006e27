# SPDX-License-Identifier: Apache-2.0
"""Scan matching by the normal distributions transform on Gaussians that lie in shared memory.

::

    from shmmap_clients.ndt_scan_matcher import NdtMatcher, Settings, VoxelMap, voxel_cell

    matcher = NdtMatcher(Settings(mode="coarse_fine"))
    matcher.set_map(VoxelMap({"map": voxel_cell(points, leaf=2.0)}))
    result = matcher.align(scan, T_guess)

The same result as Autoware's, ndt_omp's or PCL's program, by the chosen convention; see `Settings`.
"""

from shmmap_clients.ndt_scan_matcher.angles import matrix_from_pose, pose_from_matrix
from shmmap_clients.ndt_scan_matcher.backend import BACKENDS, Backend
from shmmap_clients.ndt_scan_matcher.caps import Caps, Cut
from shmmap_clients.ndt_scan_matcher.evaluation import Evaluation
from shmmap_clients.ndt_scan_matcher.matcher import NdtMatcher, Settings
from shmmap_clients.ndt_scan_matcher.regularization import Regularization
from shmmap_clients.ndt_scan_matcher.result import Result
from shmmap_clients.ndt_scan_matcher.voxel_cell import VoxelCell, cell_from_layer, voxel_cell
from shmmap_clients.ndt_scan_matcher.voxel_map import VoxelMap

__all__ = [
    "BACKENDS",
    "Backend",
    "Caps",
    "Cut",
    "Evaluation",
    "NdtMatcher",
    "Regularization",
    "Result",
    "Settings",
    "VoxelCell",
    "VoxelMap",
    "cell_from_layer",
    "matrix_from_pose",
    "pose_from_matrix",
    "voxel_cell",
]

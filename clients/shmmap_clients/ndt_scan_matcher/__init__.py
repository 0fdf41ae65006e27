# SPDX-License-Identifier: Apache-2.0
"""Scan matching by the normal distributions transform on Gaussians that lie in shared memory.

::

    from shmmap_clients.ndt_scan_matcher import NdtMatcher, Settings, VoxelMap, voxel_cell

    matcher = NdtMatcher(Settings(mode="coarse_fine"))
    matcher.set_map(VoxelMap({"map": voxel_cell(points, leaf=2.0)}))
    result = matcher.align(scan, T_guess)

The chosen variant gives the same result as the program of Autoware, ndt_omp or PCL; see `Settings`.

To follow one alignment read ``matching/matcher.py``, ``matching/newton.py``, ``backends/numba_backend.py``,
``backends/kernels.py``, ``matching/result.py``.  It also calls ``matching/evaluation.py`` (pose vectors),
``map/voxel_map.py`` (the kernel's table) and ``backends/backend.py`` (the scan's buffer).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from shmmap.lazy_imports import lazy_names

if TYPE_CHECKING:
    from shmmap_clients.ndt_scan_matcher.backends.backend import Backend, DeviceError, DeviceOptions
    from shmmap_clients.ndt_scan_matcher.backends.registry import BACKENDS
    from shmmap_clients.ndt_scan_matcher.map.map_updater import MapRules, MapUpdater
    from shmmap_clients.ndt_scan_matcher.map.voxel_map import VoxelCell, VoxelMap, cell_from_layer, voxel_cell
    from shmmap_clients.ndt_scan_matcher.matching.evaluation import (
        Evaluation,
        Scoring,
        matrix_from_pose,
        pose_from_matrix,
    )
    from shmmap_clients.ndt_scan_matcher.matching.matcher import NdtMatcher, Regularization
    from shmmap_clients.ndt_scan_matcher.matching.result import Result, TrustLimits
    from shmmap_clients.ndt_scan_matcher.matching.settings import Cut, Limits, Settings

__all__ = [
    "BACKENDS",
    "Backend",
    "Cut",
    "DeviceError",
    "DeviceOptions",
    "Evaluation",
    "Limits",
    "MapRules",
    "MapUpdater",
    "NdtMatcher",
    "Regularization",
    "Result",
    "Scoring",
    "Settings",
    "TrustLimits",
    "VoxelCell",
    "VoxelMap",
    "cell_from_layer",
    "matrix_from_pose",
    "pose_from_matrix",
    "voxel_cell",
]

__getattr__ = lazy_names(__name__)

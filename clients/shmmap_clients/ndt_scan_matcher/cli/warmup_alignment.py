# SPDX-License-Identifier: Apache-2.0
"""An alignment of a room with itself: touches all that a real one needs, in milliseconds."""

from __future__ import annotations

import numpy as np

from shmmap_clients.ndt_scan_matcher.map.voxel_cell import voxel_cell
from shmmap_clients.ndt_scan_matcher.map.voxel_map import VoxelMap
from shmmap_clients.ndt_scan_matcher.matching.matcher import NdtMatcher
from shmmap_clients.ndt_scan_matcher.matching.result import Result
from shmmap_clients.ndt_scan_matcher.matching.settings import Settings

__all__ = ["warmup_alignment"]


def warmup_alignment(settings: Settings | None = None) -> Result:
    """Align the walls of a room of 8 m with themselves from a guess 0.2 m away."""
    line = np.arange(0.1, 8.0, 0.25)
    u, v = (grid.ravel() for grid in np.meshgrid(line, line))
    flat = np.full_like(u, 0.1)
    points = np.concatenate([np.stack(wall, axis=1) for wall in ((u, v, flat), (u, flat, v), (flat, u, v))])
    guess = np.eye(4)
    guess[:3, 3] = 0.2, -0.1, 0.1
    with NdtMatcher(settings) as matcher:
        matcher.set_map(matcher.prepare(VoxelMap({"room": voxel_cell(points, 2.0)})))
        return matcher.align(points, guess)

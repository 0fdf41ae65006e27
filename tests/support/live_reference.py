# SPDX-License-Identifier: Apache-2.0
"""What a live map must hold after the drive of `tests.support.live_drive`, from the slow reference."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

import shmmap
from shmmap.chunks.voxels import ChunkKey
from shmmap.client.live.live_map import ChunkInfo, LiveMap
from tests.support.live_drive import FILTER, RESOLUTION
from tests.support.slow_occupancy import SlowOccupancy, Voxel

__all__ = ["held", "mapped_around", "reference"]

Scan = tuple[NDArray[np.float64], NDArray[np.float64]]


def reference(scans: Iterable[Scan], scan_filter: shmmap.live.ScanFilter = FILTER) -> dict[Voxel, int]:
    """Log-odds of all known voxels after these scans."""
    slow = SlowOccupancy(
        RESOLUTION, min_range=scan_filter.min_range, max_range=scan_filter.max_range,
        min_z=scan_filter.min_z, max_z=scan_filter.max_z,
    )  # fmt: skip
    for points, pose in scans:
        slow.insert(points.tolist(), pose[:3].tolist())
    return {voxel: value for voxel, value in slow.voxels.items() if value}


def held(live: LiveMap, scope: str = "all", area: shmmap.Box | None = None) -> dict[Voxel, int]:
    """Log-odds of all known voxels that a live map has."""
    found: dict[Voxel, int] = {}
    for kind in ("occupied", "free"):
        voxels = live.voxels(kind, area, scope=scope)
        for (x, y, z), value in zip(voxels.indices.tolist(), voxels.log_odds.tolist(), strict=True):
            assert (x, y, z) not in found
            found[x, y, z] = value
    return found


def mapped_around(live: LiveMap, here: ChunkKey) -> list[ChunkInfo]:
    """Return the chunks in memory that touch this one, itself among them; 27 once all have been loaded."""
    return [one for one in live.chunks() if one.key.distance(here) <= 1 and one.state != "loading"]

# SPDX-License-Identifier: Apache-2.0
"""Live maps: maps that some processes write while driving and others read (``LIVE_MAPS.md``).

`shmmap.Client.live` returns a `LiveMap`; `LiveMap.mapper` the `LiveMapper` that inserts scans.

================  ==============================================================================
`LiveMap`         a live map as readers see it: voxels of an area, states of points, changes
`LiveMapper`      inserts scans into a live map
`ScanFilter`      selects the points of a scan to use
`ScanCounts`      numbers of points of a scan, used and left out
`Occupancy`       the parameters of the occupancy model: log odds of a hit, a miss, the thresholds
`Sphere`          an area in space
`Voxels`          the result of `LiveMap.voxels`
`ChunkInfo`       one chunk in the result of `LiveMap.chunks`
`LiveMapRow`      one map in the result of `shmmap.Client.live_maps`
================  ==============================================================================
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from shmmap.lazy_imports import lazy_public_names

if TYPE_CHECKING:
    from shmmap.chunks.occupancy import Occupancy, ScanCounts, ScanFilter
    from shmmap.client.live.chunk_reader import ChunkInfo
    from shmmap.client.live.live_map import LiveMap, Sphere, Voxels
    from shmmap.client.live.mapper import LiveMapper
    from shmmap.protocol.live import LiveMapRow

__all__ = [
    "ChunkInfo",
    "LiveMap",
    "LiveMapRow",
    "LiveMapper",
    "Occupancy",
    "ScanCounts",
    "ScanFilter",
    "Sphere",
    "Voxels",
]

if not TYPE_CHECKING:
    __getattr__ = lazy_public_names(__name__)

# SPDX-License-Identifier: Apache-2.0
"""The map without bounds is what the slow reference says, and finds every voxel that is not the same."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from shmmap.chunks.occupancy import Occupancy
from shmmap.chunks.voxels import ChunkKey, voxels_of
from shmmap.demo.live_drive import UnboundedMap
from tests.support.live_drive import FILTER, RESOLUTION, Voxel, drive
from tests.support.live_reference import reference, stored_drive


def unbounded(scans: int) -> UnboundedMap:
    made = UnboundedMap(RESOLUTION, FILTER)
    for points, pose in drive(scans):
        made.add(points, pose)
    return made


def test_it_is_what_the_reference_says() -> None:
    made, expected = unbounded(6), reference(drive(6))
    found: dict[Voxel, int] = {}
    for key in {ChunkKey(x >> 6, y >> 6, z >> 6) for x, y, z in expected}:
        dense = made.chunk(key, Occupancy())
        places = np.flatnonzero(dense)
        voxels = map(tuple, voxels_of(key, places).tolist())
        found |= dict(zip(voxels, dense[places].tolist(), strict=True))
    assert found == expected


def test_each_voxel_that_differs_is_counted(tmp_path: Path) -> None:
    stored = stored_drive(tmp_path / "lidar")
    assert unbounded(6).compare(str(tmp_path / "lidar")) == (len(stored), 0)
    for scans in (5, 8):  # the files have a scan too much, and lack two of them, with their chunks
        other = reference(drive(scans))
        voxels = stored.keys() | other.keys()
        differing = sum(stored.get(voxel) != other.get(voxel) for voxel in voxels)
        assert unbounded(scans).compare(str(tmp_path / "lidar")) == (len(voxels), differing)

# SPDX-License-Identifier: Apache-2.0
"""Points outside their cell's box are counted; float32's rounding at the border is none."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from shmmap.formats.pcd.writer import write_pcd
from shmmap.layers.derive import CellJob
from shmmap.layers.making import make_layer
from shmmap.layers.spec import layer_spec
from shmmap.segment.source import Source

BOX = (90_000.0, 40_000.0, 90_020.0, 40_020.0)


def outside(tmp_path: Path, xyz: np.ndarray, layer: str = "points") -> int:
    write_pcd(tmp_path / "a.pcd", {axis: xyz[:, i] for i, axis in enumerate("xyz")})
    fd = os.memfd_create("segment")
    try:
        job = CellJob(str(tmp_path / "a.pcd"), Source(str(tmp_path / "a.pcd")), BOX, "map", ())
        return make_layer(layer_spec(layer), job, fd).header.outside_points
    finally:
        os.close(fd)


def inside(count: int = 1000, dtype: str = "f4") -> np.ndarray:
    rng = np.random.default_rng(1)
    xyz = rng.random((count, 3)) * 20 + [90_000, 40_000, 0]
    return np.clip(xyz, [90_000, 40_000, 0], [90_020, 40_020, 20]).astype(dtype)


@pytest.mark.parametrize("layer", ["points", "voxel(leaf=1.0)"])
@pytest.mark.parametrize("dtype", ["f4", "f8"])
def test_points_of_the_cell(tmp_path: Path, layer: str, dtype: str) -> None:
    assert outside(tmp_path, inside(dtype=dtype), layer) == 0


@pytest.mark.parametrize("layer", ["points", "voxel(leaf=1.0)"])
@pytest.mark.parametrize(("shift", "count"), [((100, 0, 0), 1000), ((0, -20.5, 0), 1000), ((0, 0, 5000), 0)])
def test_a_cell_that_was_moved(
    tmp_path: Path, layer: str, shift: tuple[float, float, float], count: int
) -> None:
    assert outside(tmp_path, inside() + np.array(shift, np.float32), layer) == count


def test_some_points_only_and_the_rounding_of_float32(tmp_path: Path) -> None:
    """float32 steps by 8 mm at 90 km: a point that far over the border may lie on it."""
    xyz = inside(200_000)
    xyz[::1000, 0] = 89_999.0
    assert outside(tmp_path, xyz) == 200
    xyz = inside()
    xyz[0, 0] = np.nextafter(np.float32(90_020), np.float32(1e9))
    assert outside(tmp_path, xyz) == 0
    xyz[0, 0] = 90_020.05
    assert outside(tmp_path, xyz) == 1


def test_points_that_are_not_finite_lie_nowhere(tmp_path: Path) -> None:
    xyz = inside()
    xyz[:10] = np.nan
    xyz[10] = [0, 0, 0]
    assert outside(tmp_path, xyz) == 1

# SPDX-License-Identifier: Apache-2.0
"""One row a voxel, against a dictionary of voxels; and what cannot be numbered is refused, not mixed up."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from shmmap.dividing.divide import divide
from shmmap.dividing.finishing import reduce_voxels
from shmmap.dividing.lattice import CellLattice
from shmmap.dividing.settings import DivideSettings
from shmmap.errors import BadRequest
from shmmap.formats.pcd.writer import write_pcd

ROW = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<u1"), ("label", "<u2")])


def rows_at(xyz: list[tuple[float, float, float]]) -> NDArray[np.void]:
    rows = np.zeros(len(xyz), ROW)
    for axis, values in zip("xyz", np.array(xyz, np.float32).T, strict=True):
        rows[axis] = values
    rows["intensity"] = np.arange(len(xyz)) * 37 % 251
    rows["label"] = np.arange(len(xyz))
    return rows


def index_of(value: float, lattice: CellLattice, axis: int) -> int:
    """The voxel whose half-open side holds a value, by its exact corners."""
    index = math.floor((value - lattice.origin[axis]) / lattice.size)
    index -= value < lattice.corner(index, index)[axis]
    return index + (value >= lattice.corner(index + 1, index + 1)[axis])


steps = st.integers(-40, 40)
coordinates = steps.map(lambda i: i * 0.3) | steps.map(lambda i: i * 0.25) | st.floats(-12, 12, width=32)


@given(
    st.lists(st.tuples(coordinates, coordinates, coordinates), min_size=1, max_size=60),
    st.sampled_from([(0.3, (0.0, 0.0)), (0.25, (0.1, -0.7)), (5.0, (1.0, 2.0)), (100.0, (0.0, 0.0))]),
)
@settings(max_examples=150, deadline=None)
def test_every_voxel_has_one_row(
    xyz: list[tuple[float, float, float]], how: tuple[float, tuple[float, float]]
) -> None:
    leaf, origin = how
    lattice, rows = CellLattice.of(leaf, origin), rows_at(xyz)
    upright = CellLattice.of(leaf)
    voxels: dict[tuple[int, ...], list[int]] = {}
    for number, row in enumerate(rows):
        index = (
            index_of(float(row["x"]), lattice, 0),
            index_of(float(row["y"]), lattice, 1),
            index_of(float(row["z"]), upright, 0),
        )
        voxels.setdefault(index, []).append(number)
    found = reduce_voxels(rows, lattice)
    assert found["label"].tolist() == [voxels[index][0] for index in sorted(voxels)]
    for row, (_, numbers) in zip(found, sorted(voxels.items()), strict=True):
        members = rows[numbers]
        for axis in "xyz":
            assert row[axis] == pytest.approx(members[axis].mean(dtype=np.float64), rel=1e-6, abs=1e-6)
        assert row["intensity"] == round(float(members["intensity"].mean(dtype=np.float64)))


@pytest.mark.parametrize(
    ("stray", "leaf"),
    [
        ((0.0, 0.0, 1e30), 0.5),  # further than any index
        ((0.0, 0.0, 4e9), 0.5),  # further than 2**31 voxels
        ((4e6, 0.0, 0.0), 0.001),
        ((1e6, 1e6, 2e6), 0.001),  # each axis can be numbered, all three together not
    ],
)
def test_what_cannot_be_numbered_is_refused(stray: tuple[float, float, float], leaf: float) -> None:
    rows = rows_at([(n * 0.1, 0.0, 0.0) for n in range(8)] + [stray])
    with pytest.raises(BadRequest, match="too many voxels"):
        reduce_voxels(rows, CellLattice.of(leaf))


def test_a_stray_height_leaves_no_map(tmp_path: Path) -> None:
    xyz: NDArray[Any] = np.zeros((100, 3), np.float32)
    xyz[50, 2] = 1e30
    write_pcd(tmp_path / "in.pcd", {"xyz": xyz})
    with pytest.raises(BadRequest, match="too many voxels"):
        divide([tmp_path / "in.pcd"], tmp_path / "map", DivideSettings(leaf=0.5, durable=False))
    assert [path.name for path in tmp_path.iterdir()] == ["in.pcd"]

# SPDX-License-Identifier: Apache-2.0
"""The frame of a divided map: moved, kept or given, and where its lattice begins."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from shmmap.origin.map_report import read_report
from tests.support.clouds import cloud_file, divide_quickly, expected_rows, map_rows, rows_of, xyzircaedt


def test_small_float64_coordinates_become_float32(tmp_path: Path) -> None:
    columns = {name: c.astype(np.float64) if name in "xyz" else c for name, c in xyzircaedt(800).items()}
    columns["x"][0] = np.nextafter(20.0, 0)  # becomes 20 in float32, and belongs where it then is
    made = divide_quickly([cloud_file(tmp_path / "in.pcd", columns)], tmp_path / "map", check=True)
    assert dict(made.fields)["x"] == "<f4"
    assert made.origin == (0.0, 0.0, 0.0)
    assert made.notes == []
    narrow = {name: c.astype(np.float32) if name in "xyz" else c for name, c in columns.items()}
    assert map_rows(tmp_path / "map") == expected_rows(rows_of(narrow))


@pytest.mark.parametrize("encoding", ["binary", "ascii"])
def test_large_float64_coordinates_are_moved(tmp_path: Path, encoding: str) -> None:
    columns = xyzircaedt(900)
    shift = np.array([589512.25, -4918361.5, 120.0])
    for i, axis in enumerate("xyz"):
        columns[axis] = columns[axis].astype(np.float64) + shift[i]
    made = divide_quickly([cloud_file(tmp_path / "in.pcd", columns, encoding)], tmp_path / "map", check=True)
    assert dict(made.fields)["x"] == "<f4"
    origin = np.array(made.origin)
    assert all(value % 20 == 0 for value in origin[:2])
    assert origin[2] == 0
    assert "moved by" in made.notes[0]
    assert "float32 would have lost up to 250 mm where" in made.notes[0]
    report = read_report(tmp_path / "map")
    assert report is not None
    assert tuple(report["origin"]) == made.origin
    by_time = {row[-1]: np.array(row[:3]) for row in rows_of(columns)}
    rows = [row for cell in map_rows(tmp_path / "map").values() for row in cell]
    assert len(rows) == 900
    for row in rows:
        assert np.abs(np.array(row[:3]) + origin - by_time[row[-1]]).max() <= 0.0005
    assert map_rows(tmp_path / "map") == expected_rows(sorted(rows, key=lambda row: row[-1]))


@pytest.mark.parametrize("size", [12.3457, 7.00001, 0.1])
def test_an_automatic_frame_suits_any_cell_size(tmp_path: Path, size: float) -> None:
    rng = np.random.default_rng(5)
    for number, shift in enumerate(rng.uniform(2e4, 5e6, (4, 3))):
        xyz = rng.uniform(0, 3 * size, (50, 3)) + shift
        file, out = cloud_file(tmp_path / f"{number}.pcd", {"xyz": xyz}), tmp_path / f"map{number}"
        made = divide_quickly([file], out, cell_size=size, check=True)
        assert dict(made.fields)["x"] == "<f4"
        for part in made.origin[:2]:  # whole cells away: the squares of ground stay the same
            assert Fraction(repr(part)) % Fraction(repr(size)) == 0


def test_a_frame_that_is_kept_is_kept_exactly(tmp_path: Path) -> None:
    columns = xyzircaedt(300)
    for axis in "xyz":
        columns[axis] = columns[axis].astype(np.float64) + 589512.2512345
    file = cloud_file(tmp_path / "in.pcd", columns)
    made = divide_quickly([file], tmp_path / "map", translate="none")
    assert dict(made.fields)["x"] == "<f8"
    assert "Autoware" in made.notes[0]
    assert map_rows(tmp_path / "map") == expected_rows(rows_of(columns))


@pytest.mark.parametrize("dtype", ["<f4", "<f8"])
def test_a_translation_is_applied_once(tmp_path: Path, dtype: str) -> None:
    columns = {name: c.astype(dtype) if name in "xyz" else c for name, c in xyzircaedt(300).items()}
    move = (-100.25, 33.0, 7.0)
    made = divide_quickly([cloud_file(tmp_path / "in.pcd", columns)], tmp_path / "map", translate=move)
    for axis, value in zip("xyz", move, strict=True):
        columns[axis] = (columns[axis].astype(np.float64) + value).astype(np.float32)
    assert made.origin == (100.25, -33.0, -7.0)
    # the squares of ground stay where they were, so the corners move with the points
    rows = [row for cell in map_rows(tmp_path / "map").values() for row in cell]
    assert sorted(rows, key=lambda row: row[-1]) == rows_of(columns)
    corners = [file.stem.split("_")[1:] for file in (tmp_path / "map/pointcloud_map.pcd").iterdir()]
    assert {(float(x) + 100.25) % 20 for x, _ in corners} == {0.0}


def test_the_lattice_may_start_elsewhere(tmp_path: Path) -> None:
    columns = xyzircaedt(500)
    divide_quickly(
        [cloud_file(tmp_path / "in.pcd", columns)], tmp_path / "map", origin=(5.0, -2.5), check=True
    )
    for name, rows in map_rows(tmp_path / "map").items():
        x, y = map(float, name.removesuffix(".pcd").split("_")[1:])
        assert (x - 5) % 20 == (y + 2.5) % 20 == 0
        assert all(x <= row[0] < x + 20 and y <= row[1] < y + 20 for row in rows)

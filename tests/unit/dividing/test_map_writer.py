# SPDX-License-Identifier: Apache-2.0
"""Points into cells: nothing lost, nothing in the wrong cell, and nothing half-done on the disk."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from shmmap.dividing.map_writer import MapWriter, WrittenMap
from shmmap.errors import BadRequest
from shmmap.origin.map_directory import open_map
from tests.support.divided_map import read_pcd

Columns = Mapping[str, NDArray[Any]]


def cloud(n: int, seed: int = 0, reach: float = 90.0, dtype: str = "<f4") -> dict[str, NDArray[Any]]:
    rng = np.random.default_rng(seed)
    return {
        "xyz": rng.uniform(-reach, reach, (n, 3)).astype(dtype),
        "intensity": rng.integers(0, 255, n).astype(np.float32),
        "ring": np.arange(n, dtype=np.uint16),
        "normal": np.linspace(-1, 1, n * 3).astype(np.float32).reshape(-1, 3),
    }


def write(out: Path, *parts: Columns, **options: Any) -> WrittenMap:
    with MapWriter(out, **{"durable": False, **options}) as writer:
        for part in parts:
            writer.add(part)
        return writer.finish()


def written(out: Path) -> dict[str, list[tuple[Any, ...]]]:
    """Rows of every file, read independently."""
    files = sorted((out / "pointcloud_map.pcd").iterdir())
    return {
        file.name: list(zip(*(c.tolist() for c in read_pcd(file).values()), strict=True)) for file in files
    }


def expected(columns: Columns, size: float, prefix: str) -> dict[str, list[tuple[Any, ...]]]:
    """The same, one point at a time."""
    cells: dict[str, list[tuple[Any, ...]]] = {}
    for row in zip(*(columns[name].tolist() for name in columns), strict=True):
        (x, y, _), rest = row[0], row[1:]
        corner = [index * size for index in (x // size, y // size)]
        text = "_".join(str(int(c)) if c == int(c) else str(c) for c in corner)
        cells.setdefault(f"{prefix}_{text}.pcd", []).append((*row[0], *rest))
    return dict(sorted(cells.items()))


@pytest.mark.parametrize("dtype", ["<f4", "<f8"])
@pytest.mark.parametrize("size", [20.0, 12.5, 1.0, 500.0])
def test_every_point_is_in_its_half_open_cell(tmp_path: Path, size: float, dtype: str) -> None:
    columns = cloud(800, dtype=dtype)
    columns["xyz"][:200, :2] = np.round(columns["xyz"][:200, :2] / size) * size  # exactly on borders
    result = write(tmp_path / "map", columns, cell_size=size, prefix="p")
    truth = expected(columns, size, "p")
    assert written(tmp_path / "map") == truth
    assert result == WrittenMap(str(tmp_path / "map"), len(truth), 800, 0)


def test_many_adds_equal_one(tmp_path: Path) -> None:
    columns = cloud(5000)
    whole = write(tmp_path / "whole", columns, durable=True)
    parts = [{name: column[i : i + 700] for name, column in columns.items()} for i in range(0, 5000, 700)]
    made = write(tmp_path / "parts", *parts)
    assert (made.points, made.cells) == (whole.points, whole.cells)
    truth = expected(columns, 20.0, "")
    for name in ("whole", "parts"):
        assert written(tmp_path / name) == truth
        assert sorted(os.listdir(tmp_path / name)) == ["pointcloud_map.pcd", "pointcloud_map_metadata.yaml"]


def test_points_that_are_not_finite_are_left_out_and_counted(tmp_path: Path) -> None:
    columns = cloud(1000)
    columns["xyz"][::10, 0] = np.nan
    columns["xyz"][5::10, 2] = np.inf
    result = write(tmp_path / "map", columns)
    kept = np.isfinite(columns["xyz"]).all(axis=1)
    assert (result.points, result.dropped) == (800, 200)
    assert written(tmp_path / "map") == expected({n: c[kept] for n, c in columns.items()}, 20.0, "")


def test_an_existing_map_is_never_touched(tmp_path: Path) -> None:
    out = tmp_path / "map"
    write(out, cloud(10))
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*")}
    with pytest.raises(BadRequest, match="is a map already"):
        MapWriter(out)
    (tmp_path / "file").write_text("")
    with pytest.raises(BadRequest, match="is not a directory"):
        MapWriter(tmp_path / "file")
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*")} == before
    (tmp_path / "empty").mkdir()
    assert write(tmp_path / "empty", cloud(10)).points == 10


def test_a_map_that_appeared_meanwhile_is_never_touched(tmp_path: Path) -> None:
    with MapWriter(tmp_path / "map") as writer:
        writer.add(cloud(10))
        write(tmp_path / "other", cloud(20))
        (tmp_path / "other").rename(tmp_path / "map")
        with pytest.raises(BadRequest, match="is a map already"):
            writer.finish()
    assert os.listdir(tmp_path) == ["map"]
    assert sum(map(len, written(tmp_path / "map").values())) == 20


def test_nothing_appears_before_finish_and_nothing_stays_without(tmp_path: Path) -> None:
    with MapWriter(tmp_path / "map") as writer:
        writer.add(cloud(100))
        assert not (tmp_path / "map").exists()
    assert os.listdir(tmp_path) == []
    with pytest.raises(BadRequest, match="columns changed"), MapWriter(tmp_path / "map") as writer:  # noqa: PT012
        writer.add(cloud(100))
        writer.add({"xyz": cloud(1)["xyz"]})
    assert os.listdir(tmp_path) == []
    with pytest.raises(BadRequest, match="closed"):
        writer.add(cloud(1))
    with pytest.raises(BadRequest, match="closed"):
        writer.finish()


def test_no_points_no_map(tmp_path: Path) -> None:
    with MapWriter(tmp_path / "map") as writer:
        writer.add(cloud(0))
        with pytest.raises(BadRequest, match="no points"):
            writer.finish()
    assert os.listdir(tmp_path) == []


def test_arguments_are_checked(tmp_path: Path) -> None:
    for size in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(BadRequest, match="cell size"):
            MapWriter(tmp_path / "map", cell_size=size)
    for prefix in ("a/b", "a\nb", "\0"):
        with pytest.raises(BadRequest, match="file name"):
            MapWriter(tmp_path / "map", prefix=prefix)
    good = cloud(3)
    with MapWriter(tmp_path / "map") as writer:
        for bad in (
            {"intensity": good["intensity"]},
            {"xyz": good["xyz"][:, :2]},
            {"xyz": good["xyz"].astype(np.int32)},
            {"xyz": good["xyz"], "intensity": good["intensity"][:2]},
        ):
            with pytest.raises(BadRequest):
                writer.add(bad)
        writer.add(good)
        with pytest.raises(BadRequest, match="columns changed"):
            writer.add({"xyz": good["xyz"]})
        with pytest.raises(BadRequest, match="2\\*\\*30"):
            writer.add({**good, "xyz": good["xyz"] + np.float32(3e10)})


@pytest.mark.parametrize("prefix", ["", "-a", "a b", "a: b", "'", '"', "#", "地図", "[x]"])
def test_any_prefix_comes_back(tmp_path: Path, prefix: str) -> None:
    write(tmp_path / "map", cloud(50), prefix=prefix)
    catalogue = open_map(tmp_path / "map", strict=True).load()
    assert sorted(catalogue.names.tolist()) == sorted(
        os.listdir(os.fsencode(tmp_path / "map/pointcloud_map.pcd"))
    )
    assert catalogue.problems == ()


finite = st.floats(-1e6, 1e6, width=32) | st.integers(-60, 60).map(lambda i: 20.0 * i)


@given(st.lists(st.tuples(finite, finite), min_size=1, max_size=30), st.integers(1, 30))
@settings(max_examples=60, deadline=None)
def test_any_points_end_in_a_cell_that_contains_them(
    tmp_path_factory: pytest.TempPathFactory, points: list[tuple[float, float]], at_once: int
) -> None:
    out = tmp_path_factory.mktemp("writer") / "map"
    xyz = np.array([(x, y, 0.0) for x, y in points], dtype=np.float32)
    ring = np.arange(len(points), dtype=np.uint32)
    with MapWriter(out, durable=False) as writer:
        for i in range(0, len(points), at_once):
            writer.add({"xyz": xyz[i : i + at_once], "ring": ring[i : i + at_once]})
        writer.finish()
    corners = yaml.safe_load((out / "pointcloud_map_metadata.yaml").read_text())
    seen = []
    for name, rows in written(out).items():
        corner_x, corner_y = corners[name]
        for x, y, _, index in rows:
            assert corner_x <= x < corner_x + 20
            assert corner_y <= y < corner_y + 20
            assert (x, y) == (float(xyz[index, 0]), float(xyz[index, 1]))
            seen.append(index)
    assert sorted(seen) == list(range(len(points)))

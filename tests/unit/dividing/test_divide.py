# SPDX-License-Identifier: Apache-2.0
"""Dividing: the cells together are the input, field by field and bit by bit."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from shmmap.errors import BadRequest, MapDataError
from shmmap.formats import cloud
from shmmap.origin.map_directory import open_map
from shmmap.origin.map_report import read_report
from tests.support.clouds import cloud_file, divide_quickly, expected_rows, map_rows, rows_of, xyzircaedt
from tests.support.divided_map import read_pcd
from tests.support.skips import open3d_or_skip


def read_by_the_project(path: Path) -> dict[str, Any]:
    columns = dict(cloud.read_pcd(path).columns)
    xyz = columns.pop("xyz")
    return {**{axis: xyz[:, i] for i, axis in enumerate("xyz")}, **columns}


@pytest.mark.parametrize("encoding", ["binary", "binary_compressed", "ascii"])
@pytest.mark.parametrize("size", ["20", "12.5", "0.7"])
def test_the_cells_are_the_input(tmp_path: Path, encoding: str, size: str) -> None:
    """From a file of each encoding, and in cells of each: no point and no order changes."""
    columns = xyzircaedt(4000, reach=90.0 if size != "0.7" else 5.0)
    file, truth = cloud_file(tmp_path / "in.pcd", columns, encoding), expected_rows(rows_of(columns), size)
    for written in ("binary", encoding):
        made = divide_quickly(
            [file], tmp_path / "map", cell_size=float(size), encoding=written, force=True, check=True
        )
        assert map_rows(tmp_path / "map", read_pcd if written == "binary" else read_by_the_project) == truth
        assert (made.cells, made.points, made.points_read, made.dropped) == (len(truth), 4000, 4000, 0)
        assert made.fields == [(name, column.dtype.str) for name, column in columns.items()]
        assert sorted(os.listdir(tmp_path)) == ["in.pcd", "map"]
        assert sorted(os.listdir(tmp_path / "map")) == [
            "pointcloud_map.pcd",
            "pointcloud_map_metadata.yaml",
            "shmmap_divide.json",
        ]


def test_fields_in_any_order_with_padding_and_vectors(tmp_path: Path) -> None:
    columns = xyzircaedt(500)
    header = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS intensity x _ y z normal\nSIZE 1 4 1 4 4 4\nTYPE U F U F F F\n"
        "COUNT 1 1 3 1 1 3\nWIDTH 500\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 500\nDATA binary\n"
    )
    row = np.dtype([("i", "u1"), ("x", "<f4"), ("_", "u1", 3), ("y", "<f4"), ("z", "<f4"), ("n", "<f4", 3)])
    rows = np.zeros(500, row)
    for name in "xyz":
        rows[name] = columns[name]
    rows["i"], rows["_"] = columns["intensity"], 77
    rows["n"] = np.arange(1500).reshape(-1, 3)
    (tmp_path / "in.pcd").write_bytes(header.encode() + rows.tobytes())
    made = divide_quickly([tmp_path / "in.pcd"], tmp_path / "map")
    assert [name for name, _ in made.fields] == ["intensity", "x", "y", "z", "normal"]
    seen = {}
    for file in (tmp_path / "map" / "pointcloud_map.pcd").iterdir():
        cell = read_pcd(file)
        for i, first in enumerate(cell["normal"][:, 0].tolist()):
            seen[int(first) // 3] = [cell[name][i].tolist() for name in cell]
    assert seen == {
        i: [
            columns["intensity"][i].tolist(), *(columns[axis][i].tolist() for axis in "xyz"),
            [3.0 * i, 3.0 * i + 1, 3.0 * i + 2],
        ]
        for i in range(500)
    }  # fmt: skip


def test_autoware_s_loader_reads_it(tmp_path: Path) -> None:
    divide_quickly([cloud_file(tmp_path / "in.pcd", xyzircaedt(2000))], tmp_path / "map", prefix="city")
    catalogue = open_map(tmp_path / "map", strict=True).load()
    assert catalogue.problems == ()
    assert len(catalogue) == len(map_rows(tmp_path / "map"))
    text = (tmp_path / "map" / "pointcloud_map_metadata.yaml").read_text()
    assert text.startswith("x_resolution: 20\ny_resolution: 20\ncity_-")
    assert "." not in text.replace(".pcd", "")
    for name, (x, y) in list(yaml.safe_load(text).items())[2:]:
        assert name == f"city_{x}_{y}.pcd"


def test_other_readers_read_the_cells(tmp_path: Path) -> None:
    pypcd4 = pytest.importorskip("pypcd4")
    o3d = open3d_or_skip()
    columns = xyzircaedt(1500)
    divide_quickly([cloud_file(tmp_path / "in.pcd", columns)], tmp_path / "map")
    by_time = {row[-1]: row for row in rows_of(columns)}
    seen = 0
    for file in (tmp_path / "map" / "pointcloud_map.pcd").iterdir():
        cloud = pypcd4.PointCloud.from_path(file)
        assert list(cloud.fields) == list(columns)
        for row in cloud.pc_data.tolist():
            assert row == by_time[row[-1]]
            seen += 1
        tensors = o3d.t.io.read_point_cloud(str(file)).point
        times = tensors["time_stamp"].numpy()[:, 0].tolist()
        positions = tensors["positions"].numpy().tolist()
        channels = tensors["channel"].numpy()[:, 0].tolist()
        for time, position, channel in zip(times, positions, channels, strict=True):
            assert (*position, channel) == (*by_time[time][:3], by_time[time][5])
    assert seen == 1500


def test_several_inputs_and_a_directory(tmp_path: Path) -> None:
    (tmp_path / "in" / "deep").mkdir(parents=True)
    parts = [xyzircaedt(700, seed=seed) for seed in range(3)]
    cloud_file(tmp_path / "in" / "a.pcd", parts[0])
    cloud_file(tmp_path / "in" / "deep" / "b.pcd", parts[1], "ascii")
    cloud_file(tmp_path / "c.pcd", parts[2], "binary_compressed")
    made = divide_quickly([tmp_path / "in", tmp_path / "c.pcd", tmp_path / "in" / "a.pcd"], tmp_path / "map")
    assert [source["points"] for source in made.sources] == [700] * 3
    rows = [row for part in parts for row in rows_of(part)]
    assert map_rows(tmp_path / "map") == expected_rows(rows)


def test_inputs_with_different_fields(tmp_path: Path) -> None:
    one = xyzircaedt(300)
    other = {name: column for name, column in one.items() if name != "azimuth"}
    other["channel"] = other["channel"].astype(np.uint32)
    files = [cloud_file(tmp_path / "a.pcd", one), cloud_file(tmp_path / "b.pcd", other)]
    with pytest.raises(MapDataError, match=r"azimuth, channel") as caught:
        divide_quickly(files, tmp_path / "map")
    assert "--common-fields" in caught.value.hint
    assert sorted(os.listdir(tmp_path)) == ["a.pcd", "b.pcd"]
    made = divide_quickly(files, tmp_path / "map", common_fields=True)
    names = [name for name, _ in made.fields]
    assert names == [name for name in one if name not in ("azimuth", "channel")]
    rows = rows_of({name: one[name] for name in names})
    assert map_rows(tmp_path / "map") == expected_rows(rows + rows)


def test_points_that_are_not_finite_are_left_out_and_counted(tmp_path: Path) -> None:
    columns = xyzircaedt(1000)
    columns["x"][::10] = np.nan
    columns["z"][5::10] = -np.inf
    made = divide_quickly([cloud_file(tmp_path / "in.pcd", columns)], tmp_path / "map", check=True)
    kept = np.isfinite(columns["x"]) & np.isfinite(columns["z"])
    assert (made.points, made.dropped) == (800, 200)
    assert map_rows(tmp_path / "map") == expected_rows(rows_of({n: c[kept] for n, c in columns.items()}))
    only = {name: column[~kept] for name, column in columns.items()}
    with pytest.raises(MapDataError, match="no finite point") as caught:
        divide_quickly([cloud_file(tmp_path / "none.pcd", only)], tmp_path / "none")
    assert caught.value.cause == "no_points"
    assert not (tmp_path / "none").exists()


def test_points_far_apart(tmp_path: Path) -> None:
    columns = xyzircaedt(400)
    columns["x"][::3] += 1.5e6
    columns["y"][::5] -= 2.5e6
    divide_quickly([cloud_file(tmp_path / "in.pcd", columns)], tmp_path / "map", check=True)
    assert map_rows(tmp_path / "map") == expected_rows(rows_of(columns))
    columns["x"][7] = 1e30
    with pytest.raises(BadRequest, match="2\\*\\*31"):
        divide_quickly([cloud_file(tmp_path / "far.pcd", columns)], tmp_path / "far")
    assert sorted(os.listdir(tmp_path)) == ["far.pcd", "in.pcd", "map"]


@pytest.mark.parametrize(("leaf", "size"), [(0.5, 20.0), (0.3, 7.0), (3.0, 20.0), (2.5, 2.5)])
def test_voxels_are_those_of_the_whole_cloud(tmp_path: Path, leaf: float, size: float) -> None:
    columns = xyzircaedt(6000, reach=12.0)
    file = cloud_file(tmp_path / "in.pcd", columns)
    made = divide_quickly([file], tmp_path / "map", leaf=leaf, cell_size=size, check=True)
    voxels: dict[tuple[int, ...], list[int]] = {}
    xyz = np.column_stack([columns[axis] for axis in "xyz"]).astype(np.float64)
    for i, index in enumerate(np.floor(xyz / leaf).astype(int).tolist()):
        voxels.setdefault(tuple(index), []).append(i)
    assert made.points == len(voxels)
    by_first = {members[0]: members for members in voxels.values()}
    for name, rows in map_rows(tmp_path / "map").items():
        x, y = map(float, name.removesuffix(".pcd").split("_")[1:])
        for row in rows:
            members = by_first.pop(row[-1])  # time_stamp is that of the voxel's first point
            assert x <= row[0] < x + size
            assert y <= row[1] < y + size
            assert np.allclose(row[:3], xyz[members].mean(axis=0), rtol=1e-6, atol=1e-6)
            assert row[3] == round(float(columns["intensity"][members].mean(dtype=np.float64)))
            assert row[5] == columns["channel"][members[0]]
            assert np.isclose(row[6], columns["azimuth"][members].astype(np.float64).mean(), atol=1e-6)
    assert by_first == {}


@pytest.mark.parametrize("encoding", ["binary", "binary_compressed"])
def test_a_cloud_larger_than_its_buffers(tmp_path: Path, encoding: str) -> None:
    rng = np.random.default_rng(3)
    xyz = rng.uniform(-200, 200, (1_500_000, 3)).astype(np.float32)
    number = np.arange(len(xyz), dtype=np.uint64)
    file = cloud_file(tmp_path / "in.pcd", {"xyz": xyz, "number": number}, encoding)
    made = divide_quickly([file], tmp_path / "map", memory_bytes=384 << 20, cell_size=50.0)
    assert made.points == len(xyz)
    seen = np.zeros(len(xyz), bool)
    for path in (tmp_path / "map" / "pointcloud_map.pcd").iterdir():
        cell = read_pcd(path)
        assert (np.diff(cell["number"].astype(np.int64)) > 0).all()
        assert np.array_equal(np.column_stack([cell[axis] for axis in "xyz"]), xyz[cell["number"]])
        seen[cell["number"]] = True
    assert seen.all()


def test_the_report_is_json_and_read_back(tmp_path: Path) -> None:
    made = divide_quickly([cloud_file(tmp_path / "in.pcd", xyzircaedt(10))], tmp_path / "map")
    report = read_report(tmp_path / "map")
    assert report is not None
    assert {key: report[key] for key in ("points", "cells", "path")} == {
        "points": 10, "cells": made.cells, "path": str(tmp_path / "map"),
    }  # fmt: skip
    assert read_report(tmp_path) is None
    odd = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9.pcd"))  # a name that is no UTF-8
    divide_quickly([cloud_file(odd, xyzircaedt(10))], tmp_path / "other")
    other = read_report(tmp_path / "other")
    assert other is not None
    assert other["sources"][0]["path"] == str(odd)
    for text in ("[]", "{", json.dumps({**report, "version": 99})):
        (tmp_path / "map" / "shmmap_divide.json").write_text(text)
        with pytest.raises(MapDataError):
            read_report(tmp_path / "map")


numbers = (
    st.floats(-1e6, 1e6, width=32) | st.integers(-60, 60).map(lambda i: 20.0 * i) | st.just(float("nan"))
)


@given(st.lists(st.tuples(numbers, numbers), min_size=1, max_size=40))
@settings(max_examples=40, deadline=None)
def test_any_points_end_in_the_cell_that_contains_them(
    tmp_path_factory: pytest.TempPathFactory, points: list[tuple[float, float]]
) -> None:
    folder = tmp_path_factory.mktemp("divide")
    x, y = (np.array(values, np.float32) for values in zip(*points, strict=True))
    columns = {"x": x, "y": y, "z": np.zeros(len(x), np.float32), "n": np.arange(len(x), dtype=np.uint32)}
    kept = np.isfinite(x) & np.isfinite(y)
    file = cloud_file(folder / "in.pcd", columns)
    if not kept.any():
        with pytest.raises(MapDataError):
            divide_quickly([file], folder / "map")
        return
    divide_quickly([file], folder / "map")
    assert map_rows(folder / "map") == expected_rows(rows_of({n: c[kept] for n, c in columns.items()}))

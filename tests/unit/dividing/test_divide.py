# SPDX-License-Identifier: Apache-2.0
"""Dividing: the cells together are the input, field by field and bit by bit, or nothing appears."""

from __future__ import annotations

import json
import os
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shmmap.dividing.divide import divide
from shmmap.dividing.report import DividedMap, read_report
from shmmap.dividing.settings import DivideSettings
from shmmap.errors import BadRequest, CannotWrite, MapDataError, MapMissing
from shmmap.formats import cloud
from shmmap.formats.pcd_writer import write_pcd
from shmmap.origin.map_directory import open_map
from tests.support.clouds import Columns, expected_rows, map_rows, rows_of, xyzircaedt
from tests.support.pcd_files import read_pcd


def run(inputs: list[Path], out: Path, **options: Any) -> DividedMap:
    return divide(inputs, out, DivideSettings(**{"durable": False, **options}))


def cloud_file(path: Path, columns: Columns, encoding: str = "binary") -> Path:
    write_pcd(path, columns, encoding=encoding)
    return path


@pytest.mark.parametrize("encoding", ["binary", "binary_compressed", "ascii"])
@pytest.mark.parametrize("size", ["20", "12.5", "0.7"])
def test_the_cells_are_the_input(tmp_path: Path, encoding: str, size: str) -> None:
    columns = xyzircaedt(4000, reach=90.0 if size != "0.7" else 5.0)
    made = run([cloud_file(tmp_path / "in.pcd", columns, encoding)], tmp_path / "map", cell_size=float(size))
    truth = expected_rows(rows_of(columns), size)
    assert map_rows(tmp_path / "map") == truth
    assert (made.cells, made.points, made.points_read, made.dropped) == (len(truth), 4000, 4000, 0)
    assert made.fields == [(name, column.dtype.str) for name, column in columns.items()]
    assert sorted(os.listdir(tmp_path)) == ["in.pcd", "map"]


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
    made = run([tmp_path / "in.pcd"], tmp_path / "map")
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
    run([cloud_file(tmp_path / "in.pcd", xyzircaedt(2000))], tmp_path / "map", prefix="city")
    catalogue = open_map(tmp_path / "map", strict=True).load()
    assert catalogue.problems == ()
    assert len(catalogue) == len(map_rows(tmp_path / "map"))
    text = (tmp_path / "map" / "pointcloud_map_metadata.yaml").read_text()
    assert text.startswith("x_resolution: 20\ny_resolution: 20\ncity_-")
    assert "." not in text.replace(".pcd", "")


def test_other_readers_read_the_cells(tmp_path: Path) -> None:
    pypcd4 = pytest.importorskip("pypcd4")
    o3d = pytest.importorskip("open3d")
    columns = xyzircaedt(1500)
    run([cloud_file(tmp_path / "in.pcd", columns)], tmp_path / "map")
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
    made = run([tmp_path / "in", tmp_path / "c.pcd", tmp_path / "in" / "a.pcd"], tmp_path / "map")
    assert [source["points"] for source in made.sources] == [700] * 3
    rows = [row for part in parts for row in rows_of(part)]
    assert map_rows(tmp_path / "map") == expected_rows(rows)


def test_inputs_with_different_fields(tmp_path: Path) -> None:
    one = xyzircaedt(300)
    other = {name: column for name, column in one.items() if name != "azimuth"}
    other["channel"] = other["channel"].astype(np.uint32)
    files = [cloud_file(tmp_path / "a.pcd", one), cloud_file(tmp_path / "b.pcd", other)]
    with pytest.raises(MapDataError, match=r"azimuth, channel") as caught:
        run(files, tmp_path / "map")
    assert "--common-fields" in caught.value.hint
    assert sorted(os.listdir(tmp_path)) == ["a.pcd", "b.pcd"]
    made = run(files, tmp_path / "map", common_fields=True)
    names = [name for name, _ in made.fields]
    assert names == [name for name in one if name not in ("azimuth", "channel")]
    rows = rows_of({name: one[name] for name in names})
    assert map_rows(tmp_path / "map") == expected_rows(rows + rows)


def test_points_that_are_not_finite_are_left_out_and_counted(tmp_path: Path) -> None:
    columns = xyzircaedt(1000)
    columns["x"][::10] = np.nan
    columns["z"][5::10] = -np.inf
    made = run([cloud_file(tmp_path / "in.pcd", columns)], tmp_path / "map", check=True)
    kept = np.isfinite(columns["x"]) & np.isfinite(columns["z"])
    assert (made.points, made.dropped) == (800, 200)
    assert map_rows(tmp_path / "map") == expected_rows(rows_of({n: c[kept] for n, c in columns.items()}))
    only = {name: column[~kept] for name, column in columns.items()}
    with pytest.raises(MapDataError, match="no finite point") as caught:
        run([cloud_file(tmp_path / "none.pcd", only)], tmp_path / "none")
    assert caught.value.cause == "no_points"
    assert not (tmp_path / "none").exists()


def test_points_far_apart(tmp_path: Path) -> None:
    columns = xyzircaedt(400)
    columns["x"][::3] += 1.5e6
    columns["y"][::5] -= 2.5e6
    run([cloud_file(tmp_path / "in.pcd", columns)], tmp_path / "map", check=True)
    assert map_rows(tmp_path / "map") == expected_rows(rows_of(columns))
    columns["x"][7] = 1e30
    with pytest.raises(BadRequest, match="2\\*\\*31"):
        run([cloud_file(tmp_path / "far.pcd", columns)], tmp_path / "far")
    assert sorted(os.listdir(tmp_path)) == ["far.pcd", "in.pcd", "map"]


# --- frames -------------------------------------------------------------------------------------


def test_small_float64_coordinates_become_float32(tmp_path: Path) -> None:
    columns = {name: c.astype(np.float64) if name in "xyz" else c for name, c in xyzircaedt(800).items()}
    columns["x"][0] = np.nextafter(20.0, 0)  # becomes 20 in float32, and belongs where it then is
    made = run([cloud_file(tmp_path / "in.pcd", columns)], tmp_path / "map", check=True)
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
    made = run([cloud_file(tmp_path / "in.pcd", columns, encoding)], tmp_path / "map", check=True)
    assert dict(made.fields)["x"] == "<f4"
    origin = np.array(made.origin)
    assert all(value % 20 == 0 for value in origin[:2])
    assert origin[2] == 0
    assert "moved by" in made.notes[0]
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
        made = run([file], out, cell_size=size, check=True)
        assert dict(made.fields)["x"] == "<f4"
        for part in made.origin[:2]:  # whole cells away: the squares of ground stay the same
            assert Fraction(repr(part)) % Fraction(repr(size)) == 0


def test_a_frame_that_is_kept_is_kept_exactly(tmp_path: Path) -> None:
    columns = xyzircaedt(300)
    for axis in "xyz":
        columns[axis] = columns[axis].astype(np.float64) + 589512.2512345
    file = cloud_file(tmp_path / "in.pcd", columns)
    made = run([file], tmp_path / "map", translate="none")
    assert dict(made.fields)["x"] == "<f8"
    assert "Autoware" in made.notes[0]
    assert map_rows(tmp_path / "map") == expected_rows(rows_of(columns))


@pytest.mark.parametrize("dtype", ["<f4", "<f8"])
def test_a_translation_is_applied_once(tmp_path: Path, dtype: str) -> None:
    columns = {name: c.astype(dtype) if name in "xyz" else c for name, c in xyzircaedt(300).items()}
    move = (-100.25, 33.0, 7.0)
    made = run([cloud_file(tmp_path / "in.pcd", columns)], tmp_path / "map", translate=move)
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
    run([cloud_file(tmp_path / "in.pcd", columns)], tmp_path / "map", origin=(5.0, -2.5), check=True)
    for name, rows in map_rows(tmp_path / "map").items():
        x, y = map(float, name.removesuffix(".pcd").split("_")[1:])
        assert (x - 5) % 20 == (y + 2.5) % 20 == 0
        assert all(x <= row[0] < x + 20 and y <= row[1] < y + 20 for row in rows)


# --- voxels, order, encoding --------------------------------------------------------------------


@pytest.mark.parametrize(("leaf", "size"), [(0.5, 20.0), (0.3, 7.0), (3.0, 20.0), (2.5, 2.5)])
def test_voxels_are_those_of_the_whole_cloud(tmp_path: Path, leaf: float, size: float) -> None:
    columns = xyzircaedt(6000, reach=12.0)
    file = cloud_file(tmp_path / "in.pcd", columns)
    made = run([file], tmp_path / "map", leaf=leaf, cell_size=size, check=True)
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


def read_by_the_project(path: Path) -> dict[str, Any]:
    columns = dict(cloud.read_pcd(path).columns)
    xyz = columns.pop("xyz")
    return {**{axis: xyz[:, i] for i, axis in enumerate("xyz")}, **columns}


@pytest.mark.parametrize("encoding", ["binary", "binary_compressed", "ascii"])
@pytest.mark.parametrize("order", ["input", "morton"])
def test_order_and_encoding_change_no_point(tmp_path: Path, encoding: str, order: str) -> None:
    columns = xyzircaedt(3000)
    file = cloud_file(tmp_path / "in.pcd", columns)
    made = run([file], tmp_path / "map", encoding=encoding, order=order, check=True)
    read = read_pcd if encoding == "binary" else read_by_the_project
    found, truth = map_rows(tmp_path / "map", read), expected_rows(rows_of(columns))
    if order == "morton":
        assert found != truth
        found = {name: sorted(rows, key=lambda row: row[-1]) for name, rows in found.items()}
    assert found == truth
    assert made.points == 3000
    assert sorted(os.listdir(tmp_path / "map")) == [
        "pointcloud_map.pcd", "pointcloud_map_metadata.yaml", "shmmap_divide.json",
    ]  # fmt: skip


# --- limits -------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", ["binary", "binary_compressed"])
def test_a_cloud_larger_than_its_buffers(tmp_path: Path, encoding: str) -> None:
    rng = np.random.default_rng(3)
    xyz = rng.uniform(-200, 200, (1_500_000, 3)).astype(np.float32)
    number = np.arange(len(xyz), dtype=np.uint64)
    file = cloud_file(tmp_path / "in.pcd", {"xyz": xyz, "number": number}, encoding)
    made = run([file], tmp_path / "map", memory_bytes=384 << 20, cell_size=50.0)
    assert made.points == len(xyz)
    seen = np.zeros(len(xyz), bool)
    for path in (tmp_path / "map" / "pointcloud_map.pcd").iterdir():
        cell = read_pcd(path)
        assert (np.diff(cell["number"].astype(np.int64)) > 0).all()
        assert np.array_equal(np.column_stack([cell[axis] for axis in "xyz"]), xyz[cell["number"]])
        seen[cell["number"]] = True
    assert seen.all()


def test_what_open3d_reads_must_fit(tmp_path: Path) -> None:
    with (tmp_path / "in.xyz").open("wb") as file:
        file.truncate(2 << 30)
    with pytest.raises(BadRequest, match="must be read whole") as caught:
        run([tmp_path / "in.xyz"], tmp_path / "map")
    assert "--max-memory" in caught.value.hint
    assert os.listdir(tmp_path) == ["in.xyz"]


def test_a_full_disk_is_foreseen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = cloud_file(tmp_path / "in.pcd", xyzircaedt(1000))
    real = os.statvfs(tmp_path)
    monkeypatch.setattr(os, "statvfs", lambda _: os.statvfs_result((*real[:3], 2, 2, *real[5:])))
    with pytest.raises(CannotWrite, match="are free"):
        run([file], tmp_path / "map")
    assert os.listdir(tmp_path) == ["in.pcd"]


@pytest.mark.parametrize(
    ("name", "data", "error", "cause"),
    [
        ("in.las", b"LASF" + bytes(300), MapDataError, ""),
        ("in.las", b"LASF", MapDataError, "truncated"),
        ("in.pcd", b"", MapDataError, "empty_file"),
        ("in.ply", b"ply\nformat ascii 1.0\n", MapDataError, "bad_cloud"),
        ("in.obj", b"v 1 2 3", MapDataError, "unsupported_format"),
        (None, b"", MapMissing, ""),
    ],
)
def test_bad_inputs_leave_nothing(
    tmp_path: Path, name: str | None, data: bytes, error: type[Exception], cause: str
) -> None:
    good = cloud_file(tmp_path / "good.pcd", xyzircaedt(10))
    path = tmp_path / (name or "gone.pcd")
    if name is not None:
        path.write_bytes(data)
    before = sorted(os.listdir(tmp_path))
    with pytest.raises(error) as caught:
        run([good, path], tmp_path / "map")
    assert getattr(caught.value, "cause", cause) == cause or not cause
    assert sorted(os.listdir(tmp_path)) == before


def test_a_directory_that_cannot_be_listed_is_not_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "in" / "deep").mkdir(parents=True)
    cloud_file(tmp_path / "in" / "a.pcd", xyzircaedt(10))
    scandir = os.scandir

    def refuse(path: str) -> Any:
        if path.endswith("deep"):
            raise PermissionError(13, "Permission denied", path)
        return scandir(path)

    monkeypatch.setattr(os, "scandir", refuse)  # root may list everything
    with pytest.raises(MapMissing, match=r"in/deep: Permission denied"):
        run([tmp_path / "in"], tmp_path / "map")


def test_a_file_cut_short_is_refused_before_anything_is_read(tmp_path: Path) -> None:
    file = cloud_file(tmp_path / "in.pcd", xyzircaedt(1000))
    os.truncate(file, file.stat().st_size - 1)
    with pytest.raises(MapDataError) as caught:
        run([file], tmp_path / "map")
    assert caught.value.cause == "truncated"
    assert os.listdir(tmp_path) == ["in.pcd"]


def test_an_empty_directory_and_settings_that_make_no_sense(tmp_path: Path) -> None:
    file = cloud_file(tmp_path / "in.pcd", xyzircaedt(10))
    (tmp_path / "empty").mkdir()
    with pytest.raises(MapMissing, match="no cloud"):
        run([tmp_path / "empty"], tmp_path / "map")
    for options in (
        {"cell_size": 0.0}, {"leaf": -1.0}, {"leaf": 30.0}, {"prefix": "a/b"}, {"encoding": "zip"},
        {"order": "hilbert"}, {"memory_bytes": 1 << 20}, {"translate": (0.0, float("nan"), 0.0)},
    ):  # fmt: skip
        with pytest.raises(BadRequest):
            run([file], tmp_path / "map", **options)
    with pytest.raises(BadRequest, match="nothing"):
        run([], tmp_path / "map")
    assert sorted(os.listdir(tmp_path)) == ["empty", "in.pcd"]


# --- where the output lies ----------------------------------------------------------------------


def test_a_map_is_replaced_only_by_force_and_only_a_map(tmp_path: Path) -> None:
    first, second = xyzircaedt(100), xyzircaedt(150, seed=5)
    files = [cloud_file(tmp_path / f"{i}.pcd", columns) for i, columns in enumerate((first, second))]
    out = tmp_path / "map"
    out.mkdir()
    run(files[:1], out)  # an empty directory is filled
    with pytest.raises(BadRequest, match="is a map already") as caught:
        run(files[1:], out)
    assert "--force" in caught.value.hint
    assert map_rows(out) == expected_rows(rows_of(first))
    run(files[1:], out, force=True)
    assert map_rows(out) == expected_rows(rows_of(second))
    (out / "notes.txt").write_text("mine")
    with pytest.raises(BadRequest, match="no divided map"):
        run(files[:1], out, force=True)
    link = tmp_path / "link"
    link.symlink_to(out)
    for odd in (link, files[0]):
        with pytest.raises(BadRequest):
            run(files[1:], odd, force=True)
    assert (out / "notes.txt").read_text() == "mine"
    assert map_rows(out) == expected_rows(rows_of(second))
    assert not [name for name in os.listdir(tmp_path) if name.startswith(".")]


def test_inputs_and_output_apart(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    file = cloud_file(tmp_path / "in" / "a.pcd", xyzircaedt(100))
    with pytest.raises(BadRequest, match="inside the input"):
        run([tmp_path / "in"], tmp_path / "in" / "map")
    with pytest.raises(BadRequest, match="inside the input"):
        run([tmp_path / "in"], tmp_path / "in")
    run([file], tmp_path / "map")
    cell = next((tmp_path / "map" / "pointcloud_map.pcd").iterdir())
    with pytest.raises(BadRequest, match="inside the output"):
        run([cell], tmp_path / "map", force=True)
    run([file], tmp_path / "in" / "beside")  # a file's own directory is no input
    assert sorted(os.listdir(tmp_path)) == ["in", "map"]


def test_the_parent_is_no_directory(tmp_path: Path) -> None:
    file = cloud_file(tmp_path / "in.pcd", xyzircaedt(10))
    with pytest.raises(CannotWrite):
        run([file], file / "map")


def test_the_report_is_json_and_read_back(tmp_path: Path) -> None:
    made = run([cloud_file(tmp_path / "in.pcd", xyzircaedt(10))], tmp_path / "map")
    report = read_report(tmp_path / "map")
    assert report is not None
    assert {key: report[key] for key in ("points", "cells", "path")} == {
        "points": 10, "cells": made.cells, "path": str(tmp_path / "map"),
    }  # fmt: skip
    assert read_report(tmp_path) is None
    odd = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9.pcd"))  # a name that is no UTF-8
    run([cloud_file(odd, xyzircaedt(10))], tmp_path / "other")
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
            run([file], folder / "map")
        return
    run([file], folder / "map")
    assert map_rows(folder / "map") == expected_rows(rows_of({n: c[kept] for n, c in columns.items()}))

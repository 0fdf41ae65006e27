# SPDX-License-Identifier: Apache-2.0
"""Merging is the inverse of dividing."""

from __future__ import annotations

import json
import os
import resource
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shmmap.dividing.divide import divide
from shmmap.dividing.merge import merge
from shmmap.dividing.settings import DivideSettings
from shmmap.errors import BadRequest, CannotWrite, MapDataError, MapMissing
from shmmap.formats import cloud
from shmmap.formats.pcd.writer import write_pcd
from shmmap.origin.map_report import REPORT_NAME
from tests.support.clouds import Columns, rows_of, xyzircaedt
from tests.support.divided_map import read_pcd


def divided(folder: Path, columns: Columns, **options: Any) -> Path:
    write_pcd(folder / "in.pcd", columns)
    settings = DivideSettings(durable=False, **options)
    divide([folder / "in.pcd"], folder / "map", settings)
    return folder / "map"


@pytest.mark.parametrize("encoding", ["binary", "ascii"])
def test_what_was_divided_comes_back(tmp_path: Path, encoding: str) -> None:
    columns = xyzircaedt(3000)
    made = merge([divided(tmp_path, columns)], tmp_path / "out.pcd", encoding=encoding)
    assert (made.points, made.origin) == (3000, {})
    found = cloud.read_pcd(tmp_path / "out.pcd").columns
    order = np.argsort(found["time_stamp"])
    assert np.array_equal(found["xyz"][order], np.column_stack([columns[axis] for axis in "xyz"]))
    for name in list(columns)[3:]:
        assert found[name].dtype == columns[name].dtype
        assert np.array_equal(found[name][order], columns[name])
    if encoding == "binary":
        assert sorted(rows_of(read_pcd(tmp_path / "out.pcd")), key=lambda row: row[-1]) == rows_of(columns)
    assert sorted(os.listdir(tmp_path)) == ["in.pcd", "map", "out.pcd"]


def test_a_moved_map_goes_back(tmp_path: Path) -> None:
    columns = xyzircaedt(500)
    for axis, shift in zip("xyz", (589512.25, 231300.5, 12.0), strict=True):
        columns[axis] = columns[axis].astype(np.float64) + shift
    map_dir = divided(tmp_path, columns)
    made = merge([map_dir], tmp_path / "out.pcd")
    assert list(made.origin) == [str(map_dir)]
    found = read_pcd(tmp_path / "out.pcd")
    order = np.argsort(found["time_stamp"])
    for axis in "xyz":
        assert found[axis].dtype == np.float64
        assert np.abs(found[axis][order] - columns[axis]).max() <= 0.0005
    merge([map_dir], tmp_path / "kept.pcd", keep_frame=True)
    report = json.loads((map_dir / REPORT_NAME).read_text())
    for bad in ([1e308, 0.0, 0.0], [float("nan")] * 3, "there"):
        (map_dir / REPORT_NAME).write_text(json.dumps({**report, "origin": bad}))
        with pytest.raises(MapDataError, match=f"origin in its {REPORT_NAME} is none"):
            merge([map_dir], tmp_path / "bad.pcd")
    assert read_pcd(tmp_path / "kept.pcd")["x"].dtype == np.float32


def test_more_cells_than_open_files(tmp_path: Path) -> None:
    map_dir = divided(tmp_path, xyzircaedt(3000), cell_size=5.0)
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    assert len(os.listdir(map_dir / "pointcloud_map.pcd")) > 200
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (128, hard))
        assert merge([map_dir], tmp_path / "out.pcd").points == 3000
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_refusals_leave_things_as_they_were(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    map_dir = divided(tmp_path, xyzircaedt(100))
    (tmp_path / "out.pcd").write_text("mine")
    for inputs, out, error in (
        ([map_dir], tmp_path / "out.pcd", BadRequest),
        ([map_dir], tmp_path / "out.las", BadRequest),
        ([map_dir], map_dir / "pointcloud_map.pcd", BadRequest),
        ([map_dir], map_dir / "new.pcd", BadRequest),
        ([tmp_path / "in.pcd"], tmp_path / "in.pcd", BadRequest),
        ([tmp_path / "gone.pcd"], tmp_path / "new.pcd", MapMissing),
        ([tmp_path / "out.pcd"], tmp_path / "new.pcd", MapDataError),
        ([map_dir], tmp_path / "no" / "new.pcd", CannotWrite),
    ):
        with pytest.raises(error):
            merge(inputs, out)
    with pytest.raises(BadRequest, match="inside the output"):
        merge([tmp_path / "in.pcd"], tmp_path / "in.pcd", force=True)
    assert sorted(os.listdir(tmp_path)) == ["in.pcd", "map", "out.pcd"]
    assert (tmp_path / "out.pcd").read_text() == "mine"
    merge([map_dir], tmp_path / "out.pcd", force=True)
    assert len(read_pcd(tmp_path / "out.pcd")["x"]) == 100
    real = os.statvfs(tmp_path)
    monkeypatch.setattr(os, "statvfs", lambda _: os.statvfs_result((*real[:3], 0, 0, *real[5:])))
    with pytest.raises(CannotWrite, match="are free"):
        merge([map_dir], tmp_path / "new.pcd")


@pytest.mark.parametrize("encoding", ["binary", "ascii"])
def test_withheld_points_are_left_out_and_counted(tmp_path: Path, encoding: str) -> None:
    laspy = pytest.importorskip("laspy")
    las = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
    las.x, las.y, las.z = (np.arange(100) * 0.5 for _ in range(3))
    las.withheld = np.arange(100) < 5
    las.write(tmp_path / "in.las")
    write_pcd(tmp_path / "in.pcd", {axis: np.array([1.0, np.nan]) for axis in "xyz"})
    inputs = [tmp_path / "in.las", tmp_path / "in.pcd"]
    made = merge(inputs, tmp_path / "out.pcd", encoding=encoding, common_fields=True)
    found = cloud.read_cloud(tmp_path / "out.pcd", keep_non_finite=True).xyz
    assert made.points == len(found) == 97
    assert np.array_equal(found[:95, 0], np.arange(5, 100) * 0.5)
    assert np.array_equal(found[95:, 0], [1.0, np.nan], equal_nan=True)
    assert any("5 points left out: flagged withheld" in note for note in made.notes)
    las.withheld = np.ones(100, bool)
    las.write(tmp_path / "in.las")
    with pytest.raises(MapDataError, match="left out"):
        merge([tmp_path / "in.las"], tmp_path / "none.pcd")
    assert not (tmp_path / "none.pcd").exists()


def test_a_unit_that_is_refused_names_the_verb_that_converts_it(tmp_path: Path) -> None:
    (tmp_path / "in.csv").write_text("x [mm],y [mm],z [mm]\n1,2,3\n4,5,6\n")
    with pytest.raises(MapDataError, match=r"0\.001 m") as refused:
        merge([tmp_path / "in.csv"], tmp_path / "out.pcd")
    assert "shmmap divide --unit" in refused.value.hint

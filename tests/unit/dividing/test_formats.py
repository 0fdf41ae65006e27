# SPDX-License-Identifier: Apache-2.0
"""Dividing formats other than PCD."""

from __future__ import annotations

import os
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest

from shmmap.dividing.divide import divide
from shmmap.dividing.settings import DivideSettings
from shmmap.errors import MapDataError
from shmmap.formats.cloud import read_cloud
from shmmap.formats.las_reader import LasReader
from shmmap.origin.map_report import DividedMap
from tests.support.cloud_bytes import write_las
from tests.support.clouds import map_rows, xyzircaedt
from tests.support.skips import open3d_or_skip


def run(path: Path, out: Path, **options: Any) -> DividedMap:
    return divide([path], out, DivideSettings(**{"durable": False, "check": True, **options}))


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize("point_format", [3, 6])
def test_las_keeps_every_dimension(tmp_path: Path, suffix: str, point_format: int) -> None:
    columns = xyzircaedt(2500)
    offset = (512000.0, 5403000.0, 300.0)
    for axis, shift in zip("xyz", offset, strict=True):
        columns[axis] = columns[axis].astype(np.float64) + shift
    path = tmp_path / f"in.{suffix}"
    las = write_las(path, columns, offset=offset, point_format=point_format)
    made = run(path, tmp_path / "map")
    names = [name for name, _ in made.fields]
    assert names[:4] == ["x", "y", "z", "intensity"]
    assert {"classification", "return_number", "gps_time", *list(columns)[4:]} <= set(names)
    types = dict(made.fields)
    assert (types["x"], types["channel"], types["azimuth"], types["gps_time"]) == ("<f4", "<u2", "<f4", "<f8")
    by_time = {stamp: i for i, stamp in enumerate(columns["time_stamp"].tolist())}
    seen = 0
    for rows in map_rows(tmp_path / "map").values():
        for row in rows:
            point = dict(zip(names, row, strict=True))
            i = by_time[point["time_stamp"]]
            for axis, shift in zip("xyz", made.origin, strict=True):
                assert abs(point[axis] + shift - float(np.asarray(getattr(las, axis))[i])) <= 0.0005
            for name in names[3:]:
                assert point[name] == np.asarray(las[name])[i]
            seen += 1
    assert seen == 2500


def test_las_in_blocks_from_anywhere(tmp_path: Path) -> None:
    columns = xyzircaedt(1000)
    write_las(tmp_path / "in.laz", columns)
    with LasReader(tmp_path / "in.laz") as reader:
        assert (reader.points, reader.compressed, reader.version) == (1000, True, "1.4")
        for start in (0, 1, 437, 999, 1000):
            stamps = [block["time_stamp"] for block in reader.blocks(300, start)]
            assert np.concatenate([*stamps, []]).tolist() == list(range(start, 1000))


def test_names_of_dimensions_that_pcd_does_not_have(tmp_path: Path) -> None:
    given = ["a b", "a_b", "xyz", "_", "_2", "caf\u00e9"]
    header = laspy.LasHeader(point_format=0, version="1.2")
    for name in given:
        header.add_extra_dim(laspy.ExtraBytesParams(name=name, type=np.uint16))
    las = laspy.LasData(header)
    las.x = las.y = las.z = np.arange(20.0)
    for number, name in enumerate(given):
        las[name] = np.arange(20) + 100 * number
    las.write(str(tmp_path / "in.las"))
    run(tmp_path / "in.las", tmp_path / "map", cell_size=100.0)
    columns = read_cloud(next((tmp_path / "map" / "pointcloud_map.pcd").iterdir())).columns
    assert list(columns)[-6:] == ["a_b", "a_b_2", "xyz_2", "__2", "_2", "caf\u00e9"]
    for number, name in enumerate(list(columns)[-6:]):
        assert columns[name].tolist() == list(range(100 * number, 100 * number + 20))


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize("keep", [0.0, 0.3, 0.9, 0.999])
def test_a_las_file_cut_short_is_refused(tmp_path: Path, suffix: str, keep: float) -> None:
    path = tmp_path / f"in.{suffix}"
    write_las(path, xyzircaedt(60_000))
    os.truncate(path, int(path.stat().st_size * keep))
    before = os.listdir(tmp_path)
    with pytest.raises(MapDataError):
        run(path, tmp_path / "map")
    assert os.listdir(tmp_path) == before


def test_a_las_header_that_lies_about_bounds(tmp_path: Path) -> None:
    path = tmp_path / "in.las"
    las = write_las(path, xyzircaedt(100))
    data = bytearray(path.read_bytes())
    # max_x, min_x, max_y, ... stand at byte 179; the points are moved by their offset at 155
    data[155:163] = np.float64(400_000.0).tobytes()
    path.write_bytes(bytes(data))
    del las
    with pytest.raises(MapDataError) as caught:
        run(path, tmp_path / "map")
    assert caught.value.cause == "bad_bounds"
    made = run(path, tmp_path / "map", translate=(-400_000.0, 0.0, 0.0))
    assert made.points == 100


def test_ply_as_open3d_writes_it_and_xyz(tmp_path: Path) -> None:
    o3d = open3d_or_skip()
    columns = xyzircaedt(800)
    xyz = np.column_stack([columns[axis] for axis in "xyz"])
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor.from_numpy(xyz))
    cloud.point["intensity"] = o3d.core.Tensor.from_numpy(columns["intensity"].astype(np.float32)[:, None])
    assert o3d.t.io.write_point_cloud(str(tmp_path / "in.ply"), cloud)
    np.savetxt(tmp_path / "in.xyz", xyz.astype(np.float64), fmt="%.9g")
    for name in ("in.ply", "in.xyz"):
        made = run(tmp_path / name, tmp_path / f"map-{name}")
        rows = [row for cell in map_rows(tmp_path / f"map-{name}").values() for row in cell]
        assert sorted(row[:3] for row in rows) == sorted(map(tuple, xyz.tolist()))
        assert dict(made.fields)["x"] == "<f4"
    assert ("intensity", "<f4") in run(tmp_path / "in.ply", tmp_path / "again").fields


def test_real_las_laz_and_copc(data_dir: Path, tmp_path: Path) -> None:
    for name in ("autzen_trim.las", "autzen_trim.laz", "lone-star.copc.laz"):
        path = data_dir / "las_copc" / name
        with pytest.raises(MapDataError, match="international feet") if "autzen" in name else nullcontext():
            run(path, tmp_path / name)
        made = run(path, tmp_path / name, unit="auto", force=True)
        metres = 0.3048 if "autzen" in name else 1.0
        las = laspy.read(str(path))
        assert made.points == made.points_read == len(las)
        names = [field for field, _ in made.fields]
        rows = [row for cell in map_rows(tmp_path / name).values() for row in cell]
        for i in (names.index("intensity"), names.index("gps_time")):
            assert sorted(row[i] for row in rows) == sorted(np.asarray(las[names[i]]).tolist())
        for axis in range(3):
            found = np.sort([row[axis] for row in rows]) + made.origin[axis]
            assert np.abs(found - np.sort(np.asarray(las.xyz[:, axis])) * metres).max() <= 0.0005
    one, other = (map_rows(tmp_path / f"autzen_trim.{suffix}") for suffix in ("las", "laz"))
    assert one == other

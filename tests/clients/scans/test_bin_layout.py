# SPDX-License-Identifier: Apache-2.0
"""Scans of bare rows: recognised by their numbers, named by an option, or refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from shmmap_clients.scans.bin_layout import BinLayout, guess_layout
from shmmap_clients.scans.scan_file import ScanReader

from shmmap import BadRequest, MapDataError

POINTS = 2400  # 3, 4, 5 and 6 numbers a row all divide what is written


def a_scan(points: int = POINTS, seed: int = 0, *, front: bool = False) -> dict[str, NDArray[np.float64]]:
    """Columns of a spinning LiDAR of 32 rings in a street; ``front``: all of x, y positive."""
    rng = np.random.default_rng(seed)
    azimuth = np.linspace(0.01, np.pi / 2 - 0.01 if front else 2 * np.pi, points)
    ring = np.arange(points) % 32
    elevation = np.radians(-20.0 + ring)
    away = np.minimum(rng.uniform(8, 60, points), 1.8 / np.maximum(np.sin(-elevation), 1e-3))
    columns = {
        "x": away * np.cos(azimuth),
        "y": away * np.sin(azimuth),
        "z": away * np.sin(elevation),
        "intensity": rng.integers(0, 256, points).astype(np.float64),
        "ring": ring.astype(np.float64),
        "time": np.linspace(0.0, 0.1, points),
    }
    return {name: values.astype(np.float32).astype(np.float64) for name, values in columns.items()}


def write(path: Path, columns: list[NDArray[Any]], kind: str = "<f4") -> Path:
    np.stack(columns, axis=1).astype(kind).tofile(path)
    return path


def xyz_of(scan: dict[str, NDArray[np.float64]]) -> NDArray[np.float64]:
    return np.stack([scan[axis] for axis in "xyz"], axis=1)


@pytest.mark.parametrize("front", [False, True])
@pytest.mark.parametrize("shuffled", [False, True])
@pytest.mark.parametrize("unit", [1.0, 255.0])
@pytest.mark.parametrize("kind", ["<f4", "<f8"])
@pytest.mark.parametrize(
    "names",
    ["x y z", "x y z intensity", "x y z intensity ring", "x y z intensity time", "x y z intensity ring time"],
)
def test_rows_are_recognised(
    tmp_path: Path, names: str, kind: str, unit: float, shuffled: bool, front: bool
) -> None:
    scan = a_scan(front=front)
    scan["intensity"] /= unit
    if shuffled:
        order = np.random.default_rng(1).permutation(POINTS)
        scan = {name: values[order] for name, values in scan.items()}
    path = write(tmp_path / "a.bin", [scan[name] for name in names.split()], kind)
    layout = guess_layout(str(path))
    assert layout is not None
    assert [name for name, _ in layout.columns] == names.split()
    assert {which for _, which in layout.columns} == {kind}
    read = ScanReader().read(path)
    assert read["xyz"].dtype == np.dtype(kind)
    assert np.array_equal(read["xyz"], xyz_of(scan))
    for name in names.split()[3:]:
        assert np.array_equal(read[name], scan[name].astype(kind))


def test_nuscenes_names_are_five_numbers_a_row_also_where_there_is_little(tmp_path: Path) -> None:
    scan = a_scan(40)
    path = write(
        tmp_path / "LIDAR_TOP__1.pcd.bin", [scan[name] for name in ("x", "y", "z", "intensity", "ring")]
    )
    assert np.array_equal(ScanReader().read(path)["xyz"], xyz_of(scan))


@pytest.mark.parametrize("points", [1, 2, 7, 30, 100])
def test_a_few_points_in_rows_of_kitti(tmp_path: Path, points: int) -> None:
    scan = a_scan(points)
    path = write(tmp_path / "a.bin", [scan[name] for name in ("x", "y", "z", "intensity")])
    assert np.array_equal(ScanReader().read(path)["xyz"], xyz_of(scan))


def test_no_returns_zeros_and_nan_are_points_as_well(tmp_path: Path) -> None:
    scan = a_scan()
    scan["x"][::3] = scan["y"][::3] = scan["z"][::3] = 0.0
    scan["x"][1::7] = np.nan
    path = write(tmp_path / "a.bin", [scan[name] for name in ("x", "y", "z", "intensity", "ring")])
    layout = guess_layout(str(path))
    assert layout is not None
    assert len(layout.columns) == 5
    (tmp_path / "zeros.bin").write_bytes(bytes(16 * 30))
    assert ScanReader().read(tmp_path / "zeros.bin")["xyz"].shape == (30, 3)
    (tmp_path / "empty.bin").write_bytes(b"")
    assert ScanReader().read(tmp_path / "empty.bin")["xyz"].shape == (0, 3)


def test_points_in_a_maps_frame(tmp_path: Path) -> None:
    scan = a_scan()
    path = write(
        tmp_path / "utm.bin", [scan["x"] + 455_000, scan["y"] + 5_428_000, scan["z"], scan["ring"]], "<f8"
    )
    layout = guess_layout(str(path))
    assert layout is not None
    assert len(layout.columns) == 4
    assert layout.columns[0] == ("x", "<f8")


def others() -> dict[str, NDArray[Any]]:
    scan = a_scan()
    xyz, ones = xyz_of(scan), np.ones(POINTS)
    away = np.linalg.norm(xyz, axis=1, keepdims=True)
    f4 = {
        "PointXYZI of PCL": np.column_stack([xyz, ones, scan["intensity"], np.zeros((POINTS, 3))]),
        "normals": np.column_stack([xyz, xyz / away]),
        "intensity first": np.column_stack([scan["intensity"], xyz]),
        "time of a clock": np.column_stack([xyz, 1.7e9 + scan["time"]]),
        "seven columns": np.column_stack([xyz, scan["intensity"], -scan["ring"], scan["time"], xyz[:, 0]]),
    }
    made: dict[str, NDArray[Any]] = {name: values.astype("<f4") for name, values in f4.items()}
    for kind in ("<i2", "<i4", "<f2", ">f4"):
        made[f"xyz as {kind}"] = (xyz * 100).astype(kind)
    made["noise"] = np.random.default_rng(0).integers(0, 256, 12 * 4000, np.uint8)
    made["text"] = np.frombuffer(b"1.25 -3.5 0.75 12\n" * 4000, np.uint8)
    return made


@pytest.mark.parametrize("name", sorted(others()))
def test_what_fits_nothing_is_refused_with_the_reason_and_the_option(tmp_path: Path, name: str) -> None:
    others()[name].tofile(tmp_path / "odd.bin")
    with pytest.raises(MapDataError, match=r"odd\.bin: not recognised as points: ") as refused:
        ScanReader().read(tmp_path / "odd.bin")
    assert "--bin-columns" in refused.value.hint
    said = refused.value.message
    assert any(word in said for word in (" would be ", "seem to have", "is no number of rows")), said


def test_columns_are_named(tmp_path: Path) -> None:
    scan = a_scan(50)
    kinds = [
        ("i", "<f4"),
        ("x", "<f8"),
        ("y", "<f8"),
        ("z", "<f8"),
        ("ring", "<u2"),
        ("pad", "<u2"),
        ("t", "<u4"),
    ]
    rows = np.zeros(50, np.dtype(kinds))
    rows["i"], rows["ring"], rows["t"] = scan["intensity"], scan["ring"], np.arange(50)
    for axis in "xyz":
        rows[axis] = scan[axis]
    rows.tofile(tmp_path / "own.bin")
    layout = BinLayout.parse("intensity, x:f8,y,z,ring:u2,_,t:u4")
    assert layout.row_bytes == 36
    read = ScanReader(layout).read(tmp_path / "own.bin")
    assert sorted(read) == ["intensity", "ring", "t", "xyz"]
    assert np.array_equal(read["xyz"], xyz_of(scan))
    assert read["xyz"].dtype == np.float64
    assert read["ring"].dtype == np.uint16
    assert np.array_equal(read["t"], np.arange(50))
    big = BinLayout.parse("x:>f4,y,z")
    write(tmp_path / "big.bin", [scan[axis] for axis in "xyz"], ">f4")
    read = ScanReader(big).read(tmp_path / "big.bin")
    assert read["xyz"].dtype == np.float32
    assert np.array_equal(read["xyz"], xyz_of(scan))


@pytest.mark.parametrize(
    "text",
    ["", "x,y", "x,y,z,x", "x,y,z,", "x:f3,y,z", "x:O,y,z", "x,y,z:", "xyz,x,y,z", "x y z", "x,y,z,a:f4:f8"],
)
def test_columns_that_make_no_sense_are_refused(text: str) -> None:
    with pytest.raises(BadRequest):
        BinLayout.parse(text)


def test_named_columns_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    scan = a_scan(50)
    path = write(tmp_path / "a.bin", [scan[name] for name in ("x", "y", "z", "intensity")])
    with pytest.raises(MapDataError, match="800 bytes are not a multiple of 12"):
        ScanReader(BinLayout.parse("x,y,z")).read(path)
    with pytest.raises(MapDataError, match="x would be "):
        ScanReader(BinLayout.parse("x:f8,y:f4,z")).read(path)


def test_all_scans_of_a_drive_have_one_layout_that_is_logged_once(tmp_path: Path) -> None:
    said: list[str] = []
    reader = ScanReader(say=said.append)
    (tmp_path / "0.bin").write_bytes(b"")
    for number in range(1, 4):
        scan = a_scan(seed=number)
        write(tmp_path / f"{number}.bin", [scan[name] for name in ("x", "y", "z", "intensity", "ring")])
    assert [len(reader.read(tmp_path / f"{number}.bin")["xyz"]) for number in range(4)] == [0, *[POINTS] * 3]
    assert len(said) == 1
    assert "rows of 5 float32, x y z intensity ring" in said[0]
    assert "--bin-columns" in said[0]
    other = a_scan(POINTS + 1)
    write(tmp_path / "4.bin", [other[axis] for axis in "xyz"])
    with pytest.raises(MapDataError, match=r"4\.bin"):
        reader.read(tmp_path / "4.bin")

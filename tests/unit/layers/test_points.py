# SPDX-License-Identifier: Apache-2.0
"""The points layer: a file's bits in a segment, and how many of its points lie outside the cell's box."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import xxhash

from shmmap.errors import MapDataError
from shmmap.formats.pcd.writer import write_pcd
from shmmap.layers.build import make_layer
from shmmap.layers.points import BUILDER_VERSION, build_points
from shmmap.layers.sources import CellJob
from shmmap.layers.spec import layer_spec
from shmmap.segment.header import unpack_header
from shmmap.segment.version import Source
from tests.support.cloud_bytes import Field, column, pcd

ENCODINGS = ("ascii", "binary", "binary_compressed")
BOX = (0.0, 0.0, 20.0, 20.0)
FAR_BOX = (90_000.0, 40_000.0, 90_020.0, 40_020.0)


@pytest.fixture
def segment() -> Iterator[int]:
    fd = os.memfd_create("segment")
    yield fd
    os.close(fd)


def content(fd: int) -> bytes:
    return os.pread(fd, os.fstat(fd).st_size, 0)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("bad", [(), (3,), (0, 299), tuple(range(300))])
def test_a_segment_holds_the_kept_points(
    tmp_path: Path, segment: int, encoding: str, bad: tuple[int, ...]
) -> None:
    rows = 300
    x = [math.nan if row in bad else row / 8 for row in range(rows)]
    fields = [
        column("intensity", "U1", [row % 256 for row in range(rows)]),
        column("x", "F4", x),
        column("y", "F4", [row / 4 for row in range(rows)]),
        column("z", "F4", [-row / 2 for row in range(rows)]),
        Field("h", "I", 8, tuple((row, -row) for row in range(rows)), 2),
    ]
    path = tmp_path / "cell.pcd"
    path.write_bytes(pcd(fields, encoding))
    asked: list[int] = []
    returned = build_points(str(path), segment, cell_id=str(path), box=BOX, reserve=asked.append)
    data = content(segment)
    header = unpack_header(memoryview(data), len(data))
    assert repr(header) == repr(returned)  # NaN bounds are not equal to themselves
    assert asked[-1] == header.total_bytes == len(data)
    kept = [row for row in range(rows) if row not in bad]
    assert (header.rows, header.source_points, header.dropped_points) == (len(kept), rows, len(bad))
    assert (header.cell_id, header.layer, header.box) == (str(path), "points", BOX)
    assert header.builder_version == BUILDER_VERSION
    assert header.source_digest == xxhash.xxh3_128(path.read_bytes()).digest()
    status = path.stat()
    assert header.source == (status.st_size, status.st_mtime_ns, status.st_ctime_ns)
    expected = {
        "xyz": np.array([[x[row], row / 4, -row / 2] for row in kept], "<f4").reshape(-1, 3),
        "intensity": np.array([row % 256 for row in kept], "u1"),
        "h": np.array([[row, -row] for row in kept], "<i8").reshape(-1, 2),
    }
    assert [entry.name for entry in header.columns] == list(expected)
    for entry in header.columns:
        raw = data[entry.offset : entry.offset + entry.nbytes]
        assert raw == expected[entry.name].tobytes()
        assert entry.shape == expected[entry.name].shape
        assert entry.offset % 64 == 0
        assert entry.checksum == xxhash.xxh3_64(raw).intdigest()
    if kept:
        assert (header.z_min, header.z_max) == (-kept[-1] / 2, -kept[0] / 2)
    else:
        assert math.isnan(header.z_min)
        assert math.isnan(header.z_max)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_dropping_points_gives_the_bytes_of_a_file_without_them(
    tmp_path: Path, segment: int, encoding: str
) -> None:
    """Also across blocks: nothing of the first pass remains."""
    rows = 140_000 if encoding == "binary" else 2_000
    good = [column(name, "F4", [float(row) for row in range(rows)]) for name in "xyz"]
    odd = [column(name, "F4", [math.inf, *(float(row) for row in range(rows)), math.nan]) for name in "xyz"]
    path = tmp_path / "cell.pcd"
    columns = []
    for fields in (good, odd):
        path.write_bytes(pcd(fields, encoding))
        os.ftruncate(segment, 0)
        header = build_points(str(path), segment, cell_id="cell", box=BOX)
        data = content(segment)
        assert len(data) == header.total_bytes
        columns.append(data[header.header_bytes :])
    assert columns[0] == columns[1]


def test_a_refused_reservation_writes_nothing(tmp_path: Path, segment: int) -> None:
    path = tmp_path / "cell.pcd"
    path.write_bytes(pcd([column(name, "F4", [1.0] * 1000) for name in "xyz"], "binary"))

    def refuse(nbytes: int) -> None:
        raise MemoryError(nbytes)

    with pytest.raises(MemoryError):
        build_points(str(path), segment, cell_id="cell", box=BOX, reserve=refuse)
    assert os.fstat(segment).st_size == 0


def test_a_bad_file_reserves_nothing(tmp_path: Path, segment: int) -> None:
    path = tmp_path / "cell.pcd"
    path.write_bytes(pcd([column(name, "F4", [1.0] * 10) for name in "xyz"], "binary")[:-1])
    asked: list[int] = []
    with pytest.raises(MapDataError):
        build_points(str(path), segment, cell_id="cell", box=BOX, reserve=asked.append)
    assert asked == []


def test_a_file_that_changes_meanwhile_is_refused(tmp_path: Path, segment: int) -> None:
    path = tmp_path / "cell.pcd"
    path.write_bytes(pcd([column(name, "F4", [1.0] * 10) for name in "xyz"], "binary"))

    def rewrite(nbytes: int) -> None:
        with open(path, "ab") as file:
            file.write(b"more")

    with pytest.raises(MapDataError) as caught:
        build_points(str(path), segment, cell_id="cell", box=BOX, reserve=rewrite)
    assert caught.value.cause == "changed"


def outside(tmp_path: Path, xyz: np.ndarray, layer: str = "points") -> int:
    write_pcd(tmp_path / "a.pcd", {axis: xyz[:, i] for i, axis in enumerate("xyz")})
    fd = os.memfd_create("segment")
    try:
        job = CellJob(str(tmp_path / "a.pcd"), Source(str(tmp_path / "a.pcd")), FAR_BOX, "map", ())
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

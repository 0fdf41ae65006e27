# SPDX-License-Identifier: Apache-2.0
"""What a LAS header counts against the bytes that are there: said, or refused; scales that make no place."""

from __future__ import annotations

import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import laspy
import numpy as np
import pytest

from shmmap.dividing.divide import divide
from shmmap.dividing.settings import DivideSettings
from shmmap.errors import MapDataError
from shmmap.formats.cloud import describe, read_cloud
from tests.support.cloud_bytes import POINTS, las_file, patched


def said(path: Path) -> str:
    """Warnings of the three readers of a file, which are the same."""
    warnings = describe(path).warnings
    assert read_cloud(path).warnings == warnings
    made = divide([path], path.with_suffix(".map"), DivideSettings(durable=False, force=True))
    for warning in warnings:
        assert any(warning in note for note in made.notes)
    return " ".join(warnings)


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize(("version", "form"), [("1.4", 6), ("1.2", 3)])
def test_sound_files_say_nothing(tmp_path: Path, suffix: str, version: str, form: int) -> None:
    assert said(las_file(tmp_path / f"a.{suffix}", version=version, form=form)) == ""


def test_half_of_the_points_counted(tmp_path: Path) -> None:
    path = patched(las_file(tmp_path / "a.las"), 247, "Q", POINTS // 2)
    assert read_cloud(path).points == POINTS // 2
    assert f"{500 * 30} bytes after the last point ignored, room for 500 more points" in said(path)
    old = patched(las_file(tmp_path / "b.las", version="1.2", form=3), 107, "I", POINTS - 1)
    assert "34 bytes after the last point ignored, room for 1 more points" in said(old)


def test_half_of_a_compressed_chunk_counted(tmp_path: Path) -> None:
    """Chunks of point formats from 6 on count their points, be there one chunk or more."""
    path = patched(las_file(tmp_path / "a.laz"), 247, "Q", POINTS // 2)
    assert "the header counts 500 points, the compressed data 1000" in said(path)
    path = patched(las_file(tmp_path / "b.laz", points=120_000), 247, "Q", 110_000)
    assert "the header counts 110000 points, the compressed data 120000" in said(path)


def test_compressed_chunks_that_are_not_counted(tmp_path: Path) -> None:
    path = las_file(tmp_path / "a.laz", version="1.2", form=3, points=120_000)
    assert "there: the chunks behind are ignored" in said(patched(path, 107, "I", 60_000))


def test_points_of_copc_that_are_not_counted(data_dir: Path, tmp_path: Path) -> None:
    path = tmp_path / "a.copc.laz"
    path.write_bytes((data_dir / "las_copc" / "lone-star.copc.laz").read_bytes())
    patched(path, 247, "Q", 518_862 - 5)
    assert "the header counts 518857 points, the compressed data 518862" in " ".join(describe(path).warnings)


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_only_the_legacy_field(tmp_path: Path, suffix: str) -> None:
    path = las_file(tmp_path / f"a.{suffix}", form=3)
    patched(path, 247, "Q", 0)
    patched(path, 107, "I", POINTS)
    assert "only the legacy count says how many points there are, 1000" in said(path)
    cloud = read_cloud(path)
    assert (cloud.points, cloud.xyz[-1].tolist()) == (POINTS, pytest.approx([99.9] * 3))
    patched(path, 247, "Q", POINTS)
    patched(path, 107, "I", 7)
    assert "the header counts 1000 points, its legacy count 7" in said(path)


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize(
    ("change", "cause", "words"),
    [
        (lambda path: patched(path, 247, "Q", 0), "bad_las", "counts no points, but"),
        (lambda path: patched(path, 131, "d", 0.0), "bad_las", "the scale of x is 0"),
        (lambda path: patched(path, 147, "d", float("nan")), "bad_las", "the scale of z is nan"),
        (lambda path: patched(path, 163, "d", float("inf")), "bad_las", "the offset of y is inf"),
        (lambda path: patched(path, 139, "d", 1e-300), "bad_las", "the scale of y is 1e-300"),
        (lambda path: patched(path, 131, "d", 1e308), "bad_las", "the scale of x is 1e+308"),
        (lambda path: patched(path, 171, "d", -1e308), "bad_las", "the offset of z is -1e+308"),
        (lambda path: patched(path, 25, "B", 5), "bad_las", "LAS 1.5; 1.0 to 1.4 are read"),
        (lambda path: patched(path, 104, "B", 0x80 | 11), "bad_las", "point format 11; 0 to 10 are read"),
        (lambda path: patched(path, 247, "Q", 10**9), "truncated", "1000000000 points announced"),
        (lambda path: patched(path, 247, "Q", 10**18), "truncated", "points announced"),
        (lambda path: path, "", ""),
    ],
)
def test_what_contradicts_itself_is_refused(
    tmp_path: Path, suffix: str, change: Callable[[Path], Path], cause: str, words: str
) -> None:
    path = change(las_file(tmp_path / f"a.{suffix}"))
    if not cause:
        assert read_cloud(path).points == POINTS
        return
    for read in (read_cloud, describe):
        with pytest.raises(MapDataError) as caught:
            read(path)
        assert (caught.value.cause, words in str(caught.value)) == (cause, True), str(caught.value)
        assert caught.value.offset is not None
    with pytest.raises(MapDataError):
        divide([path], tmp_path / "map", DivideSettings(durable=False))


@pytest.mark.parametrize("bounds", [(0.0, 0.0), (float("nan"), float("nan")), (-5.0, 5.0)])
def test_bounds_that_could_not_be_true_are_not_believed(tmp_path: Path, bounds: tuple[float, float]) -> None:
    """A writer that leaves them out: float32 would have lost half a metre, and nothing said so."""
    path = las_file(tmp_path / "a.las")
    patched(path, 155, "3d", 5e6, 5e6, 0.0)
    patched(path, 179, "6d", *bounds * 3)
    made = divide([path], tmp_path / "map", DivideSettings(durable=False, check=True))
    assert made.bounds is not None
    assert np.array(made.bounds[1]) + made.origin == pytest.approx([5e6 + 99.9, 5e6 + 99.9, 99.9], abs=1e-3)


@pytest.mark.parametrize("at", [94, 96, 100, 235, 243])
def test_records_that_are_not_there(tmp_path: Path, at: int) -> None:
    """Any value of what says where records are: read, warned of, or refused; never a crash or a hang."""
    original = las_file(tmp_path / "o.las").read_bytes()
    for value in (0, 1, 0xFFFF, 0x7FFFFFFF):
        path = tmp_path / "a.las"
        path.write_bytes(original)
        patched(path, at, "H" if at == 94 else "I", value & (0xFFFF if at == 94 else 0xFFFFFFFF))
        try:
            points = read_cloud(path).points
        except MapDataError as error:
            points = POINTS if error.cause in ("bad_las", "truncated") else -1
        assert points == POINTS


# --- records that announce more than they have -------------------------------------------------------------

UTM = b'PROJCS["WGS 84 / UTM zone 32N",GEOGCS["W"],UNIT["metre",1],AUTHORITY["EPSG","32632"]]'


def with_extended(path: Path, records: list[tuple[int, int, bytes]], **header: int) -> Path:
    """Append extended records (number, announced bytes, bytes); long ones become holes of the file."""
    data = bytearray(las_file(path).read_bytes())
    at, count = header.get("at", len(data)), header.get("count", len(records))
    struct.pack_into("<QI", data, 235, at, count)
    with open(path, "wb") as file:
        file.write(data)
        for number, announced, content in records:
            file.write(struct.pack("<2x16sHQ32x", b"LASF_Projection", number, announced) + content)
            if announced < 1 << 40:
                file.seek(announced - len(content), 1)
        file.truncate()
    return path


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize(
    ("records", "header", "warned", "named"),
    [
        ([(1, 3 << 30, b""), (2112, len(UTM), UTM)], {}, "", True),
        ([(2112, 3 << 30, UTM)], {}, "", True),
        ([(1, 1 << 62, b"abc")], {}, "behind the file's end", False),
        ([(2112, 1 << 62, UTM)], {}, "behind the file's end", True),
        ([(1, 3, b"abc")], {"at": 0}, "1 extended records announced at byte 0", False),
        ([(1, 3, b"abc")], {"at": 1 << 62}, "1 extended records announced at byte 4611", False),
        ([(2112, len(UTM), UTM)], {"count": 0xFFFFFFFF}, "where there is room for 2", True),
    ],
)
def test_extended_records_are_not_read_for_nothing(
    tmp_path: Path,
    suffix: str,
    records: list[tuple[int, int, bytes]],
    header: dict[str, int],
    warned: str,
    named: bool,
) -> None:
    path = with_extended(tmp_path / f"a.{suffix}", records, **header)
    tracemalloc.start()
    try:
        found = describe(path)
        assert tracemalloc.get_traced_memory()[1] < 50 << 20
    finally:
        tracemalloc.stop()
    assert found.points == POINTS
    assert warned in " ".join(found.warnings)
    assert bool(found.warnings) == bool(warned)
    assert (found.crs is not None and found.crs.epsg == 32632) == named


def test_a_gap_before_the_points_is_not_read(tmp_path: Path) -> None:
    data = bytearray(las_file(tmp_path / "a.las").read_bytes())
    (data_at,) = struct.unpack_from("<I", data, 96)
    struct.pack_into("<I", data, 96, 3 << 30)
    with open(tmp_path / "a.las", "wb") as file:
        file.write(data[:data_at])
        file.seek(3 << 30)
        file.write(data[data_at:])
    tracemalloc.start()
    try:
        cloud = read_cloud(tmp_path / "a.las")
        assert tracemalloc.get_traced_memory()[1] < 50 << 20
    finally:
        tracemalloc.stop()
    np.testing.assert_allclose(cloud.xyz[:, 0], np.arange(POINTS) * 0.1, atol=0.005)


def test_a_table_of_more_chunks_than_memory(tmp_path: Path) -> None:
    path = las_file(tmp_path / "a.laz")
    data = bytearray(path.read_bytes())
    (data_at,) = struct.unpack_from("<I", data, 96)
    struct.pack_into("<q", data, data_at, 3 << 30)
    with open(path, "wb") as file:
        file.write(data)
        file.seek(3 << 30)
        file.write(struct.pack("<II", 0, 1 << 27) + bytes(1 << 10))
    with pytest.raises(MapDataError, match="134217728 chunks announced"):
        describe(path)


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize(
    ("there", "described", "kept", "lost"),
    [
        ([("a", "f4")], [("a", "f4"), ("b", "f8")], ["a"], "'b'"),
        ([], [("a", "f4"), ("b", "f8")], [], "'a', 'b'"),
        ([("a", "u1"), ("b", "3f4")], [("a", "u1"), ("b", "3f4"), ("c", "i2")], ["a", "b"], "'c'"),
        ([("a", "u1"), ("b", "f4")], [("a", "u1"), ("b", "f4")], ["a", "b"], ""),
    ],
)
def test_extra_bytes_that_the_points_do_not_have(
    tmp_path: Path,
    suffix: str,
    there: list[tuple[str, str]],
    described: list[tuple[str, str]],
    kept: list[str],
    lost: str,
) -> None:
    def written(name: str, dims: list[tuple[str, str]]) -> bytes:
        header = laspy.LasHeader(point_format=6, version="1.4")
        header.add_extra_dims([laspy.ExtraBytesParams(*dim) for dim in dims])
        header.vlrs.append(laspy.VLR("pad", 1, "", b""))  # so that the record can grow over it
        las = laspy.LasData(header)
        las.x = las.y = las.z = np.arange(POINTS) * 0.1
        for dim, kind in dims:
            las[dim] = (
                np.arange(POINTS * int(kind[0] if kind[0].isdigit() else 1)).reshape(POINTS, -1).squeeze()
            )
        las.write(str(tmp_path / name))
        return (tmp_path / name).read_bytes()

    original, more = (written(f"{name}.{suffix}", dims) for name, dims in (("a", there), ("b", described)))
    (old_at,), (new_at,) = (struct.unpack_from("<I", data, 96) for data in (original, more))
    records = more[375:new_at] if suffix == "las" else None
    if records is None:  # the LASzip record is that of the points
        at = more.index(b"LASF_Spec") - 2
        (size,) = struct.unpack_from("<H", more, at + 20)
        rest = original[375:old_at]
        if there:
            own = rest.index(b"LASF_Spec") - 2
            rest = rest[:own] + rest[own + 54 + struct.unpack_from("<H", rest, own + 20)[0] :]
        records = more[at : at + 54 + size] + rest
    shift = 375 + len(records) - old_at
    data = bytearray(original[:375] + records + original[old_at:])
    struct.pack_into("<II", data, 96, 375 + len(records), struct.unpack_from("<I", more, 100)[0])
    if suffix == "laz":
        struct.pack_into(
            "<q", data, 375 + len(records), struct.unpack_from("<q", original, old_at)[0] + shift
        )
    path = tmp_path / f"c.{suffix}"
    path.write_bytes(bytes(data))
    cloud = read_cloud(path)
    assert [name for name in cloud.columns if name in "abc"] == kept
    for name in kept:
        np.testing.assert_array_equal(cloud.columns[name], laspy.read(tmp_path / f"a.{suffix}")[name])
    assert lost in said(path)
    assert bool(said(path)) == bool(lost)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize(
    ("place", "value", "note", "column"),
    [
        (2, b"\x00\x00", "", "bar"),  # no bytes: it describes nothing
        (3, b"\x08", "'foo' has scale 0, which is ignored", "foo"),
        (2, b"\x63\x00", "does not fit", ""),  # a type that is not defined
        (4, b"\xff\xfe\0", "no name of its own", "__"),
        (4, b"X\0", "no name of its own", "X_2"),
        (4, b"withheld\0", "no name of its own", "withheld_2"),
        (4, b"bar\0", "no name of its own", "bar"),
        (4, b"\0", "no name of its own", "extra"),
        (2, b"\x01", "describes 2 bytes, its points have 9", ""),
    ],
)
def test_extra_bytes_described_badly(
    tmp_path: Path, suffix: str, place: int, value: bytes, note: str, column: str
) -> None:
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.add_extra_dims([laspy.ExtraBytesParams("foo", "f8"), laspy.ExtraBytesParams("bar", "u1")])
    las = laspy.LasData(header)
    las.x, las.y, las.z = (np.arange(10.0) for _ in range(3))
    las.foo, las.bar = np.arange(10) + 0.5, np.arange(10)
    path = tmp_path / f"a{suffix}"
    las.write(path)
    content = bytearray(path.read_bytes())
    at = content.index(b"LASF_Spec") + 52 + place
    content[at : at + len(value)] = value
    path.write_bytes(content)
    found = read_cloud(path)
    assert np.array_equal(found.xyz[:, 0], np.arange(10.0))
    assert note in " ".join(found.warnings)
    assert not column or column in found.columns
    if place in (3, 4):
        assert np.array_equal(found.columns[column], np.arange(10) + 0.5)
    for name in ("withheld", "classification", "gps_time"):
        assert not found.columns[name].any()


def test_points_within_the_header(tmp_path: Path) -> None:
    las = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
    las.x, las.y, las.z = (np.arange(10.0) for _ in range(3))
    las.write(tmp_path / "a.las")
    content = bytearray((tmp_path / "a.las").read_bytes())
    content[96:100] = (100).to_bytes(4, "little")
    (tmp_path / "a.las").write_bytes(content)
    with pytest.raises(MapDataError, match="within its header"):
        read_cloud(tmp_path / "a.las")

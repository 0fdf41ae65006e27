# SPDX-License-Identifier: Apache-2.0
"""Every PLY that the standard allows is read whole, each column with its type; others are refused clearly."""

from __future__ import annotations

import io
import random
import struct
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import plyfile
import pytest

from shmmap.dividing.divide import divide
from shmmap.dividing.settings import DivideSettings
from shmmap.errors import MapDataError
from shmmap.formats.cloud import describe, read_cloud
from shmmap.formats.ply_reader import PlyReader
from shmmap.formats.source_file import CAUSES
from tests.support.cloud_bytes import random_ply

FORMS = ("ascii", "binary_little_endian", "binary_big_endian")
CODES = {"float": "f", "double": "d", "short": "h", "ushort": "H", "uchar": "B", "uint": "I", "int": "i"}


def ply(
    form: str, properties: Sequence[tuple[str, str]], rows: Sequence[tuple[float, ...]], *,
    newline: str = "\n", before: str = "", lines: str = "", ahead: bytes = b"", count: int | None = None,
) -> bytes:  # fmt: skip
    """Return a file whose vertices have properties (type, name), after ``before`` with bytes ``ahead``."""
    head = f"ply\nformat {form} 1.0\n{before}element vertex {len(rows) if count is None else count}\n"
    head += "".join(f"property {kind} {name}\n" for kind, name in properties) + lines + "end_header\n"
    order = ">" if "big" in form else "<"
    if form == "ascii":
        body = "".join(" ".join(map(repr, row)) + newline for row in rows).encode()
    else:
        code = order + "".join(CODES[kind] for kind, _ in properties)
        body = b"".join(struct.pack(code, *row) for row in rows)
    return head.replace("\n", newline).encode() + ahead + body


def written(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


def test_two_hundred_headers_as_plyfile_reads_them(tmp_path: Path) -> None:
    rng = random.Random(20)
    kinds = set()
    for number in range(200):
        data = random_ply(rng)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # numpy's, of an element without rows
            vertex = plyfile.PlyData.read(io.BytesIO(data))["vertex"]
        scalars = [one for one in vertex.properties if not isinstance(one, plyfile.PlyListProperty)]
        cloud = read_cloud(written(tmp_path / "a.ply", data), keep_non_finite=True)
        assert cloud.points == vertex.count, number
        assert list(cloud.columns)[1:] == [one.name for one in scalars if one.name not in "xyz"], number
        for one in scalars:
            values = vertex[one.name]
            if one.name in "xyz":
                ours = cloud.xyz[:, "xyz".index(one.name)]
                assert ours.tolist() == values.astype(np.float64).tolist(), (number, one.name)
            else:
                ours = cloud.columns[one.name]
                assert ours.dtype == values.dtype.newbyteorder("<"), (number, one.name)
                assert ours.tobytes() == values.astype(ours.dtype).tobytes(), (number, one.name)
        lists = [one.name for one in vertex.properties if isinstance(one, plyfile.PlyListProperty)]
        assert bool(lists) == any("list properties" in warning for warning in cloud.warnings)
        kinds.add((data.split()[2], bool(lists), b"\r\n" in data[:5]))
    assert len(kinds) == 12  # every encoding, with and without lists, of both line ends


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    "kinds",
    [("float", "float", "double"), ("double", "float", "float"), ("int", "float", "short"), ("short",) * 3],
)
def test_coordinates_of_any_type(tmp_path: Path, form: str, kinds: tuple[str, ...]) -> None:
    """Open3D read z up to 2048 m for 5 where the axes had different types."""
    rows = [(1.0, 2.0, 5.0), (-3.0, 4.0, 6.0)]
    if "float" not in kinds or "int" in kinds:
        rows = [(1, 2, 5), (-3, 4, 6)]
    data = ply(form, list(zip(kinds, "xyz", strict=True)), [tuple(row) for row in rows])
    cloud = read_cloud(written(tmp_path / "a.ply", data))
    assert cloud.xyz.tolist() == [[1, 2, 5], [-3, 4, 6]]
    assert cloud.xyz.dtype == (np.float64 if {"double", "int"} & set(kinds) else np.float32)
    made = divide([tmp_path / "a.ply"], tmp_path / "map", DivideSettings(durable=False, check=True))
    assert made.bounds == [[-3, 2, 5], [1, 4, 6]]


@pytest.mark.parametrize("form", FORMS)
def test_every_column_keeps_name_and_type(tmp_path: Path, form: str) -> None:
    kinds = [
        ("float", "x"), ("float", "y"), ("float", "z"), ("double", "nx"), ("float", "ny"), ("float", "nz"),
        ("uchar", "red"), ("uchar", "green"), ("ushort", "blue"), ("ushort", "intensity"), ("short", "ring"),
        ("uint", "gps"), ("double", "time"),
    ]  # fmt: skip
    row = (1.0, 2.0, 3.0, 0.1, 0.5, -0.5, 255, 128, 65535, 40000, -7, 4_000_000_000, 1.6e9 + 0.125)
    data = ply(form, kinds, [row, row])
    cloud = read_cloud(written(tmp_path / "a.ply", data))
    assert {name: values.dtype.str for name, values in cloud.columns.items()} == {
        "xyz": "<f4", "nx": "<f8", "ny": "<f4", "nz": "<f4", "red": "|u1", "green": "|u1", "blue": "<u2",
        "intensity": "<u2", "ring": "<i2", "gps": "<u4", "time": "<f8",
    }  # fmt: skip
    assert [cloud.columns[name][1] for _, name in kinds[3:]] == pytest.approx(row[3:], abs=0)
    assert cloud.warnings == ()
    made = divide([tmp_path / "a.ply"], tmp_path / "map", DivideSettings(durable=False, check=True))
    assert dict(made.fields)["gps"] == "<u4"
    described = describe(tmp_path / "a.ply")
    assert (described.format, described.encoding, described.points) == ("ply", form, 2)
    assert len(described.columns) == 11


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
def test_line_ends(tmp_path: Path, form: str, newline: str) -> None:
    """Of binary files the first byte of a point may be 10 or 13."""
    ten = struct.unpack("<f" if "little" in form else ">f", b"\n\n\r\n")[0]
    rows = [(ten, 2.0, 3.0), (1.0, -2.0, ten)]
    data = ply(form, [("float", axis) for axis in "xyz"], rows, newline=newline)
    assert read_cloud(written(tmp_path / "a.ply", data)).xyz.tolist() == [list(row) for row in rows]


@pytest.mark.parametrize("form", FORMS)
def test_faces_and_cameras_before_the_vertices(tmp_path: Path, form: str) -> None:
    order = ">" if "big" in form else "<"
    faces = [(3, 0, 1, 2), (0,), (4, 0, 1, 2, 3)]
    ahead = b"".join(struct.pack(f"{order}B{len(face) - 1}i", *face) for face in faces)
    ahead += struct.pack(f"{order}2d", 1.5, 2.5)
    if form == "ascii":
        ahead = "".join(" ".join(map(str, face)) + "\n" for face in faces).encode() + b"1.5 2.5\n"
    before = "element face 3\nproperty list uchar int vertex_index\nelement camera 1\nproperty double a\n"
    before += "property double b\n"
    rows = [(1.0, 2.0, 3.0), (4.0, 5.0, 6.0)]
    data = ply(form, [("float", axis) for axis in "xyz"], rows, before=before, ahead=ahead)
    assert read_cloud(written(tmp_path / "a.ply", data)).xyz.tolist() == [[1, 2, 3], [4, 5, 6]]


def test_lists_in_the_vertices_in_pieces(tmp_path: Path) -> None:
    """Rows longer than what is read at a time, and a start in the middle as a resumed `divide` makes it."""
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 50\nproperty float x\n"
    head += (
        "property list uint uchar a\nproperty float y\nproperty float z\nproperty ushort ring\nend_header\n"
    )
    sizes = [0, 3, 2_000_000, 1, 70_000]
    body = b"".join(
        struct.pack("<fI", i, sizes[i % 5]) + bytes(sizes[i % 5]) + struct.pack("<2fH", -i, 2 * i, i)
        for i in range(50)
    )
    path = written(tmp_path / "a.ply", head.encode() + body)
    with PlyReader(path) as reader:
        for start in (0, 7, 48):
            blocks = [{k: v.copy() for k, v in block.items()} for block in reader.blocks(16, start)]
            assert np.concatenate([block["ring"] for block in blocks]).tolist() == list(range(start, 50))
            assert blocks[-1]["xyz"][-1].tolist() == [49, -49, 98]
        assert reader.warnings == ("list properties of the vertices left out: a",)
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(MapDataError, match="within row 50 of 50") as caught:
        read_cloud(path)
    assert (caught.value.cause, caught.value.offset) == ("truncated", path.stat().st_size)


def test_oddities_are_said(tmp_path: Path) -> None:
    properties = [("float", "X"), ("float", "Y"), ("float", "Z"), ("uchar", "xyz"), ("uchar", "_")]
    data = ply("binary_big_endian", properties, [(1.0, 2.0, 3.0, 4, 5)]) + bytes(7)
    data = data.replace(b"element", "comment gemessen in München\nobj_info é\nelement".encode("latin-1"), 1)
    cloud = read_cloud(written(tmp_path / "a.ply", b"\xef\xbb\xbf" + data))
    assert {name: values.tolist() for name, values in cloud.columns.items()} == {
        "xyz": [[1, 2, 3]], "xyz_2": [4], "__2": [5],
    }  # fmt: skip
    said = " ".join(cloud.warnings)
    for words in ("byte order mark", "'X' is taken as 'x'", "'xyz' renamed 'xyz_2'", "7 bytes after"):
        assert words in said


XYZ = [("float", axis) for axis in "xyz"]
GOOD = ply("binary_little_endian", XYZ, [(1.0, 2.0, 3.0)] * 3)
TEXT = ply("ascii", XYZ, [(1.0, 2.0, 3.0)] * 3)


@pytest.mark.parametrize(
    ("data", "cause", "words"),
    [
        (b"", "empty_file", "0 bytes"),
        (bytes(4096), "zero_filled", "zero bytes"),
        (b"version https://git-lfs.github.com/spec/v1\n", "lfs_pointer", "git-lfs"),
        (b"PLY\n" + GOOD[4:], "bad_header", "does not start"),
        (b"# .PCD v0.7\n", "bad_header", "does not start"),
        (GOOD[:-1], "truncated", "3 rows of element vertex need 36 bytes"),
        (GOOD[:60], "truncated", "inside its header"),
        (TEXT[:-5], "bad_row", "row 3: 2 values, 3 are needed"),
        (GOOD.replace(b"vertex 3", b"vertex 99999999999"), "truncated", "99999999999 rows"),
        (GOOD.replace(b"vertex 3", b"vertex 999999999999999999999"), "too_many_points", "rows"),
        (GOOD.replace(b"vertex 3", b"vertex " + b"9" * 5000), "too_many_points", "rows"),
        (GOOD.replace(b"vertex 3", b"vertex -3"), "bad_header", "not a number of rows"),
        (TEXT.replace(b"vertex 3", b"vertex 4"), "truncated", "4 vertices announced, 3 rows"),
        (TEXT.replace(b"vertex 3", b"vertex 400000000"), "truncated", "characters"),
        (GOOD.replace(b"float z", b"float w"), "no_xyz", "no property z"),
        (GOOD.replace(b"property float z\n", b""), "no_xyz", "no property z"),
        (GOOD.replace(b"float z", b"list uchar float z"), "no_xyz", "no property z"),
        (GOOD.replace(b"float z", b"half z"), "bad_type", "'half'"),
        (GOOD.replace(b"float z", b"list float uchar z"), "bad_type", "counted by float"),
        (GOOD.replace(b"float z", b"float \xc3\xa9"), "bad_header", "not ASCII"),
        (GOOD.replace(b"little_endian", b"middle_endian"), "unknown_encoding", "middle_endian"),
        (GOOD.replace(b"format binary_little_endian 1.0\n", b""), "bad_header", "no format line"),
        (GOOD.replace(b"element vertex 3", b"element face 3"), "bad_header", "no element vertex"),
        (GOOD.replace(b"end_header", b"element vertex 3\nend_header"), "bad_header", "two elements vertex"),
        (GOOD.replace(b"element vertex 3\n", b""), "bad_header", "not one of PLY's"),
        (GOOD.replace(b"end_header", b"elephant\nend_header"), "bad_header", "elephant"),
        (TEXT.replace(b"2.0", b"two", 1), "bad_row", "row 1: 'two' is not a number of type f4"),
        (TEXT.replace(b"2.0", b"", 1), "bad_row", "row 1: 2 values, 3 are needed"),
        (TEXT.replace(b"float z", b"uchar z").replace(b"3.0", b"300"), "bad_row", "'300' is not a number of"),
        (TEXT.replace(b"float z", b"float z\nproperty list uchar int a"), "bad_row", "'' is not a number of"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_with_its_place(tmp_path: Path, data: bytes, cause: str, words: str) -> None:
    path = written(tmp_path / "a.ply", data)
    with pytest.raises(MapDataError) as caught:
        read_cloud(path)
    assert cause in CAUSES
    assert (caught.value.cause, words in str(caught.value)) == (cause, True), str(caught.value)
    assert caught.value.path == str(path)
    assert caught.value.offset is not None
    assert 0 <= caught.value.offset <= len(data)
    with pytest.raises(MapDataError):
        divide([path], tmp_path / "map", DivideSettings(durable=False, check=True))
    assert not (tmp_path / "map").exists()


@pytest.mark.parametrize("items", [-1, 2**31 - 1])
def test_lists_of_absurd_length(tmp_path: Path, items: int) -> None:
    head = "ply\nformat binary_big_endian 1.0\nelement face 2\nproperty list int double a\nelement vertex 1\n"
    head += "property float x\nproperty float y\nproperty float z\nend_header\n"
    path = written(tmp_path / "a.ply", head.encode() + struct.pack(">i", items) + bytes(40))
    with pytest.raises(MapDataError) as caught:
        read_cloud(path)
    assert caught.value.cause == ("bad_row" if items < 0 else "truncated")

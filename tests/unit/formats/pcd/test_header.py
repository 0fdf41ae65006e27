# SPDX-License-Identifier: Apache-2.0
"""Header dialects that must read, and headers that must be refused by name."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmmap.errors import MapDataError
from shmmap.formats.pcd import header as pcd_header
from shmmap.formats.pcd.header import PcdHeader, parse_header
from shmmap.formats.source_file import CAUSES, refusal
from tests.support.cloud_bytes import Field, column, header, pcd

XYZ = [column(name, "F4", [1.0, 2.0]) for name in "xyz"]
WITH = [*XYZ, column("intensity", "U1", [1, 2])]


def parse(data: bytes) -> PcdHeader:
    return parse_header(data, path="some.pcd", file_bytes=len(data))


def cause(data: bytes) -> str:
    with pytest.raises(MapDataError) as caught:
        parse(data)
    assert caught.value.cause in CAUSES
    assert caught.value.path == "some.pcd"
    assert caught.value.offset is not None
    assert 0 <= caught.value.offset <= len(data)
    return caught.value.cause


def test_a_plain_header() -> None:
    data = pcd(WITH, "binary")
    found = parse(data)
    assert [(f.name, f.dtype.str, f.count, f.padding) for f in found.fields] == [
        ("x", "<f4", 1, False),
        ("y", "<f4", 1, False),
        ("z", "<f4", 1, False),
        ("intensity", "|u1", 1, False),
    ]
    assert (found.width, found.height, found.points, found.point_bytes) == (2, 1, 2, 13)
    assert (found.encoding, found.version, found.warnings) == ("binary", "0.7", ())
    assert list(found.viewpoint) == [0, 0, 0, 1, 0, 0, 0]
    assert data[: found.data_offset].endswith(b"DATA binary\n")


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_lines_in_any_order(newline: str) -> None:
    keys = ["VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS"]
    plain = parse(pcd(WITH, "binary"))
    for order in itertools.islice(itertools.permutations(keys), 0, None, 4001):
        found = parse(pcd(WITH, "binary", order=order, newline=newline))
        assert (found.fields, found.points, found.warnings) == (plain.fields, plain.points, ())


@pytest.mark.parametrize(
    ("left_out", "extent"),
    [
        (["VERSION"], (2, 1, 2)),
        (["COUNT"], (2, 1, 2)),
        (["VIEWPOINT"], (2, 1, 2)),
        (["POINTS"], (2, 1, 2)),
        (["HEIGHT"], (2, 1, 2)),
        (["POINTS", "HEIGHT"], (2, 1, 2)),
        (["WIDTH"], (2, 1, 2)),
        (["WIDTH", "HEIGHT"], (2, 1, 2)),
        (["VERSION", "COUNT", "VIEWPOINT", "POINTS"], (2, 1, 2)),
    ],
)
def test_lines_that_may_be_missing(left_out: list[str], extent: tuple[int, int, int]) -> None:
    found = parse(pcd(WITH, "binary", change=dict.fromkeys(left_out)))
    assert (found.width, found.height, found.points) == extent
    assert found.warnings == ()


@pytest.mark.parametrize(
    "left_out", [["FIELDS"], ["SIZE"], ["TYPE"], ["POINTS", "WIDTH"], ["POINTS", "WIDTH", "HEIGHT"]]
)
def test_lines_that_may_not(left_out: list[str]) -> None:
    assert cause(pcd(WITH, "binary", change=dict.fromkeys(left_out))) == "bad_header"


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"DATA": "binary_zstd"}, "unknown_encoding"),
        ({"DATA": ""}, "unknown_encoding"),
        ({"DATA": "bin"}, "unknown_encoding"),
        ({"POINTS": "-5"}, "bad_header"),
        ({"POINTS": "2.0"}, "bad_header"),
        ({"POINTS": "0x2"}, "bad_header"),
        ({"POINTS": "2 2"}, "bad_header"),
        ({"POINTS": ""}, "bad_header"),
        ({"POINTS": "9" * 5000}, "bad_header"),
        ({"POINTS": "1_0"}, "bad_header"),
        ({"WIDTH": "-1"}, "bad_header"),
        ({"HEIGHT": "x"}, "bad_header"),
        ({"POINTS": "3"}, "truncated"),
        ({"POINTS": str(2**32)}, "too_many_points"),
        ({"POINTS": None, "WIDTH": "4294967295", "HEIGHT": "4294967295"}, "too_many_points"),
        ({"VIEWPOINT": "0 0 0 1 0 0"}, "bad_header"),
        ({"VIEWPOINT": "0 0 0 1 0 0 0 0"}, "bad_header"),
        ({"VIEWPOINT": "0 0 0 1 0 0 nan"}, "bad_header"),
        ({"VIEWPOINT": "0 0 0 1 0 0 inf"}, "bad_header"),
        ({"VIEWPOINT": "0 0 0 1 0 0 zero"}, "bad_header"),
        ({"SIZE": "4 4 4"}, "bad_header"),
        ({"SIZE": "4 4 4 1 1"}, "bad_header"),
        ({"TYPE": "F F F"}, "bad_header"),
        ({"COUNT": "1 1 1"}, "bad_header"),
        ({"COUNT": "1 1 1 0"}, "bad_header"),
        ({"COUNT": "1 1 1 -1"}, "bad_header"),
        ({"COUNT": "1 1 1 1000000000"}, "bad_header"),
        ({"COUNT": "1 1 1 2000000"}, "bad_header"),
        ({"COUNT": "1 1 1 " + "9" * 5000}, "bad_header"),
        ({"COUNT": "2 1 1 1"}, "no_xyz"),
        ({"SIZE": "4 4 4 3", "TYPE": "F F F U"}, "bad_type"),
        ({"SIZE": "4 4 4 2", "TYPE": "F F F F"}, "bad_type"),
        ({"SIZE": "4 4 4 16", "TYPE": "F F F F"}, "bad_type"),
        ({"TYPE": "F F F Q"}, "bad_type"),
        ({"TYPE": "F F F FF"}, "bad_type"),
        ({"SIZE": "4 4 4 one"}, "bad_type"),
        ({"SIZE": "4 4 4 -1"}, "bad_type"),
        ({"FIELDS": "x y w intensity"}, "no_xyz"),
        ({"FIELDS": "a b c d"}, "no_xyz"),
        ({"FIELDS": "x y z a\x07b"}, "bad_header"),
        ({"FIELDS": ""}, "bad_header"),
    ],
)
def test_headers_that_are_refused(change: dict[str, str | None], name: str) -> None:
    assert cause(pcd(WITH, "binary", change=change)) == name


@pytest.mark.parametrize(
    ("data", "name"),
    [
        (b"", "empty_file"),
        (bytes(4096), "zero_filled"),
        (bytes(100_000), "zero_filled"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 5\n", "lfs_pointer"),
        (b"hello, I am not a point cloud\n" * 5, "not_pcd"),
        (b"ply\nformat ascii 1.0\n", "not_pcd"),
        (b"LASF" + bytes(300), "not_pcd"),
        (b"# only\n# comments\n", "not_pcd"),
        (b"\n\n\n", "not_pcd"),
        (b"VERSION 0.7\nFIELDS x y z\n", "truncated"),
        (b"VERSION 0.7\n" + b"# long\n" * 20_000, "bad_header"),
        (b"# a\n" * 17_000 + pcd(XYZ, "binary"), "not_pcd"),
        (b"x" * 100_000, "not_pcd"),
    ],
)
def test_what_is_no_pcd(data: bytes, name: str) -> None:
    assert cause(data) == name


@pytest.mark.parametrize(
    ("data", "word"),
    [
        (pcd(WITH, "binary", change={"WIDTH": "3"}), "WIDTH"),
        (pcd(WITH, "binary", change={"WIDTH": "1"}), "WIDTH"),
        (pcd(WITH, "binary", change={"HEIGHT": "5"}), "HEIGHT"),
        (pcd(WITH, "binary", change={"FIELDS": "X Y Z intensity"}), "'X' is taken as 'x'"),
        (pcd(WITH, "binary", change={"FIELDS": "x y z x"}), "renamed"),
        (pcd(WITH, "binary", change={"FIELDS": "x y z xyz"}), "renamed"),
        (pcd(WITH, "binary", change={"FIELDS": "x y z " + "n" * 60}), "renamed"),
        (pcd(WITH, "binary", change={"VERSION": "0.7\nCOLOUR blue"}), "COLOUR"),
        (pcd(WITH, "binary", change={"VERSION": "0.7\nPOINTS 2"}), "twice"),
        (pcd(WITH, "binary", change={"VIEWPOINT": "0 0 1 1 0 0 0"}), "VIEWPOINT"),
        (pcd(WITH, "binary", change={"DATA": "binary really"}), "DATA"),
        (b"\xef\xbb\xbf" + pcd(WITH, "binary"), "byte order mark"),
        (header(WITH, "binary").lower() + bytes(26), "lower case"),
    ],
)
def test_oddities_read_with_a_warning(data: bytes, word: str) -> None:
    found = parse(data)
    assert found.points == 2
    assert any(word in warning for warning in found.warnings), found.warnings
    assert len(found.warnings) == (1 if b"X Y Z" not in data else 3)


def test_two_different_lines_of_one_key_are_refused() -> None:
    assert cause(pcd(WITH, "binary", change={"VERSION": "0.7\nPOINTS 1"})) == "bad_header"


def test_harmless_variations_are_silent() -> None:
    for change in (
        {"VERSION": ".5"},
        {"VERSION": ".7 by hand"},
        {"TYPE": "f f f u"},
        {"VIEWPOINT": "0 0 0 -1 0 0 0"},
    ):
        assert parse(pcd(WITH, "binary", change={**change})).warnings == ()
    assert parse(pcd(WITH, "binary", change={"VERSION": "0.7\n\n# caf\xe9\n"})).warnings == ()
    assert parse(pcd(WITH, "binary").replace(b"FIELDS", b"COLUMNS")).warnings == ()
    assert parse(pcd(WITH, "binary").replace(b"FIELDS ", b" FIELDS\t ")).warnings == ()


def test_duplicates_get_unused_numbers() -> None:
    names = "x y z a a a_2 _ _ a y xyz"
    kinds = {
        "SIZE": "4 " * 11,
        "TYPE": "F " * 11,
        "COUNT": "1 " * 11,
        "FIELDS": names,
        "POINTS": "0",
        "WIDTH": "0",
    }
    found = [field.name for field in parse(pcd(XYZ, "binary", change={**kinds})).fields]
    assert found == ["x", "y", "z", "a", "a_3", "a_2", "_", "_", "a_4", "y_2", "xyz_2"]


@pytest.mark.parametrize("copies", [2, 300])
def test_long_duplicates_stay_short_and_unique(copies: int) -> None:
    long = "é" * 40
    names = ["x", "y", "z"] + [long] * copies
    count = len(names)
    text = " ".join(names).encode().decode("latin-1")
    change: dict[str, str | None] = {
        "FIELDS": text,
        "SIZE": "4 " * count,
        "TYPE": "F " * count,
        "COUNT": "1 " * count,
        "POINTS": "0",
        "WIDTH": "0",
    }
    found = [field.name for field in parse(pcd(XYZ, "binary", change=change)).fields]
    assert len(set(found)) == count
    assert all(len(name.encode()) <= 40 for name in found)
    assert found[3] == "é" * 20


def test_field_names_that_are_not_utf8_are_taken_as_latin1() -> None:
    found = parse(pcd(WITH, "binary").replace(b"intensity", b"intensit\xe4t"))
    assert found.fields[3].name == "intensität"


def test_padding_may_have_count_zero_and_any_number() -> None:
    pad = Field("_", "U", 1, ((), ()), 0)
    found = parse(pcd([*XYZ, pad, pad], "binary"))
    assert [(field.padding, field.count) for field in found.fields[3:]] == [(True, 0), (True, 0)]
    assert found.point_bytes == 12


def test_data_line_without_newline_ends_the_file() -> None:
    empty = [column(name, "F4", []) for name in "xyz"]
    found = parse(header(empty, "binary")[:-1])
    assert found.data_offset == len(header(empty, "binary")) - 1
    assert cause(header(XYZ, "binary")[:-1]) == "truncated"


@given(st.binary(max_size=400))
def test_any_bytes_are_parsed_or_refused(data: bytes) -> None:
    found = ""
    try:
        parse(data)
    except MapDataError as error:
        found = error.cause
    assert found == "" or found in CAUSES


def test_only_listed_causes_can_be_raised() -> None:
    with pytest.raises(KeyError):
        refusal("no such cause", "message", path="x")


def test_headers_that_share_lines_keep_their_own_numbers() -> None:
    """A header like one seen before is recognised; everything that differs must still count."""
    pcd_header._seen.clear()
    first = parse(pcd(WITH, "binary"))
    again = parse(pcd(WITH, "binary"))
    assert again == first
    assert again.fields is first.fields
    three = [column(field.name, f"{field.kind}{field.size}", [1, 2, 3]) for field in WITH]
    wide = parse(pcd(three, "binary", change={"WIDTH": "1", "HEIGHT": "3"}))
    assert (wide.width, wide.height, wide.points) == (1, 3, 3)
    assert pcd(three, "binary")[wide.data_offset :] == pcd(three, "binary")[-39:]
    assert parse(pcd(three, "binary", change={"WIDTH": "2"})).warnings
    assert cause(pcd(WITH, "binary")[:-1]) == "truncated"
    assert cause(pcd(WITH, "binary", change={"POINTS": "9" * 10, "WIDTH": "9" * 10})) == "too_many_points"
    assert cause(pcd(WITH, "binary", change={"POINTS": "3", "WIDTH": "3"})) == "truncated"
    assert parse(pcd(WITH, "ascii")).encoding == "ascii"
    assert parse(pcd(WITH, "binary", change={"TYPE": "F F F I"})).fields[3].dtype.str == "|i1"
    assert parse(pcd(WITH, "binary", change={"VIEWPOINT": "1 0 0 1 0 0 0"})).warnings
    assert parse(pcd(WITH, "binary", change={"VIEWPOINT": "1 0 0 1 0 0 0"})).warnings
    for _ in range(2):
        assert cause(pcd(WITH, "binary", change={"FIELDS": "x y w i"})) == "no_xyz"
    for number in range(200):
        assert (
            parse(pcd(WITH, "binary", change={"FIELDS": f"x y z f{number}"})).fields[3].name == f"f{number}"
        )
    assert len(pcd_header._seen) <= pcd_header._SEEN_LIMIT

# SPDX-License-Identifier: Apache-2.0
"""Text bodies: exact numbers, odd lines, and garbage named with its place."""

from __future__ import annotations

import math
import struct
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from shmmap.errors import MapDataError
from shmmap.formats.pcd.reader import PcdReader
from tests.support.cloud_bytes import CODES, Field, column, header

XYZ = [column(name, "F4", [1.0, 2.0, 3.0]) for name in "xyz"]


def read(
    tmp_path: Path, text: bytes, fields: list[Field], **options: Any
) -> tuple[dict[str, Any], PcdReader]:
    path = tmp_path / "cloud.pcd"
    path.write_bytes(header(fields, "ascii") + text)
    with PcdReader(path, **options) as reader:
        columns: dict[str, Any] = {spec.name: [] for spec in reader.columns}
        for block in reader.blocks():
            for spec, values in zip(reader.columns, block, strict=True):
                columns[spec.name] += values.tolist()
    return columns, reader


def refused(tmp_path: Path, text: bytes, fields: list[Field]) -> MapDataError:
    with pytest.raises(MapDataError) as caught:
        read(tmp_path, text, fields)
    return caught.value


def one(tmp_path: Path, kind: str, token: str) -> Any:
    fields = [*(column(name, "F4", [1.0]) for name in "xyz"), column("v", kind, [0])]
    return read(tmp_path, f"1 2 3 {token}\n".encode(), fields)[0]["v"][0]


@pytest.mark.parametrize(
    ("kind", "token", "value"),
    [
        ("U8", "18446744073709551615", 2**64 - 1),
        ("U8", "9007199254740993", 2**53 + 1),
        ("I8", "-9223372036854775808", -(2**63)),
        ("I8", "9007199254740993", 2**53 + 1),
        ("U4", "4294967295", 2**32 - 1),
        ("U4", "4.2108e+06", 4210800),
        ("I1", "-128", -128),
        ("I2", "3.0", 3),
        ("U1", "+7", 7),
        ("U1", "007", 7),
        ("U8", "18446744073709551615.0", 2**64 - 1),
        ("U8", "1e19", 10**19),
        ("F8", "1630577758.569490194", 1630577758.569490194),
        ("F8", "0.1", 0.1),
        ("F8", "1e-320", 1e-320),
        ("F8", "5e-324", 5e-324),
        ("F8", ".5", 0.5),
        ("F8", "5.", 5.0),
        ("F8", "-INF", -math.inf),
        ("F8", "Infinity", math.inf),
        ("F4", "1e300", math.inf),
        ("F4", "0.1", struct.unpack("<f", struct.pack("<f", 0.1))[0]),
        ("F4", "16777217", 16777216.0),
    ],
)
def test_numbers(tmp_path: Path, kind: str, token: str, value: float) -> None:
    assert one(tmp_path, kind, token) == value


@pytest.mark.parametrize("token", ["nan", "-nan", "NaN", "NAN", "+nan"])
def test_nan_spellings(tmp_path: Path, token: str) -> None:
    assert math.isnan(one(tmp_path, "F4", token))
    assert math.isnan(one(tmp_path, "F8", token))


@pytest.mark.parametrize(
    ("kind", "token"),
    [
        ("U1", "256"),
        ("U1", "-1"),
        ("U8", "-1"),
        ("I1", "128"),
        ("U8", "18446744073709551616"),
        ("I8", "9223372036854775808"),
        ("U4", "1.5"),
        ("U4", "nan"),
        ("I4", "inf"),
        ("U8", "1e99999999"),
        ("U8", "-1e99999999"),
        ("U8", "1e-5"),
        ("U8", "9" * 5000),
        ("I4", "1_000"),
        ("F4", "1_000"),
        ("F8", "abc"),
        ("F8", "0x10"),
        ("F8", "1,5"),
        ("F8", "1.5f"),
        ("F8", "--1"),
        ("F8", "1e"),
        ("F8", "."),
        ("F8", "nan(1)"),
        ("F8", "\u0663"),
        ("F8", "1\0"),
    ],
)
def test_garbage_is_named_with_row_and_offset(tmp_path: Path, kind: str, token: str) -> None:
    fields = [*XYZ, column("v", kind, [0, 0, 0])]
    text = b"# first\n1 2 3 4\n\n  1 2 3 " + token.encode() + b"\n1 2 3 4\n"
    error = refused(tmp_path, text, fields)
    assert error.cause == "bad_row"
    assert "row 2" in str(error)
    assert error.offset == len(header(fields, "ascii")) + len(b"# first\n1 2 3 4\n\n")


@given(st.data())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=150)
def test_integers_are_exact(tmp_path: Path, data: st.DataObject) -> None:
    kind, size = data.draw(st.sampled_from([key for key in CODES if key[0] != "F"]))
    low, high = (0, 2 ** (8 * size) - 1) if kind == "U" else (-(2 ** (8 * size - 1)), 2 ** (8 * size - 1) - 1)
    values = data.draw(st.lists(st.integers(low, high), min_size=1, max_size=20))
    fields = [column(name, "F4", [1.0] * len(values)) for name in "xyz"]
    text = "".join(f"1 2 3 {value}\n" for value in values).encode()
    found = read(tmp_path, text, [*fields, column("v", f"{kind}{size}", [0] * len(values))])[0]
    assert found["v"] == values


@given(st.lists(st.decimals(allow_nan=False, allow_infinity=False, places=12), min_size=1, max_size=10))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_doubles_are_correctly_rounded(tmp_path: Path, values: list[Any]) -> None:
    fields = [column(name, "F4", [1.0] * len(values)) for name in "xyz"]
    text = "".join(f"1 2 3 {value}\n" for value in values).encode()
    found = read(tmp_path, text, [*fields, column("v", "F8", [0.0] * len(values))])[0]["v"]
    for value, got in zip(values, found, strict=True):
        exact = Fraction(value)
        near = [got, math.nextafter(got, math.inf), math.nextafter(got, -math.inf)]
        assert min(near, key=lambda candidate: abs(Fraction(candidate) - exact)) == got


def test_lines_of_every_kind(tmp_path: Path) -> None:
    text = b"\r\n# comment\n1 2 3\r\n \t \n  4\t5\v6 \n#\n7 8 9"
    found, reader = read(tmp_path, text, XYZ)
    assert found["xyz"] == [[1, 2, 3], [4, 5, 6], [7, 8, 9]]
    assert reader.warnings == ("4 blank or comment lines among the points ignored",)
    clean, reader = read(tmp_path, b"1 2 3\r\n4 5 6\r\n7 8 9\r\n", XYZ)
    assert clean == found
    assert reader.warnings == ()


@pytest.mark.parametrize("block_points", [1, 2, 3, 1000])
def test_lines_after_the_last_point(tmp_path: Path, block_points: int) -> None:
    text = b"1 2 3\n4 5 6\n7 8 9\n# end\n1 2 3\nmore\n"
    found, reader = read(tmp_path, text, XYZ, block_points=block_points)
    assert found["xyz"] == [[1, 2, 3], [4, 5, 6], [7, 8, 9]]
    assert any(warning.startswith("2 lines after") for warning in reader.warnings)


@pytest.mark.parametrize(
    ("text", "row"),
    [
        (b"1 2 3\n4.25 5\n7 8 9\n", 2),
        (b"1 2 3\n4 5 6 7\n7 8 9\n", 2),
        (b"1 2 3 4 5 6\n7 8 9\n", 1),
        (b"1 2\n3 4 5 6\n7 8 9\n", 1),
        (b"1 2 3\n4 5 6\n7,8,9\n", 3),
        (b"1 2 3\n4 5 6\n7 8 9 # comment\n", 3),
    ],
)
def test_rows_of_the_wrong_length(tmp_path: Path, text: bytes, row: int) -> None:
    error = refused(tmp_path, text, XYZ)
    assert error.cause == "bad_row"
    assert f"row {row}:" in str(error)
    assert error.offset == len(header(XYZ, "ascii")) + sum(len(x) + 1 for x in text.split(b"\n")[: row - 1])


def test_too_few_rows(tmp_path: Path) -> None:
    error = refused(tmp_path, b"1 2 3\n# padding so that the size alone does not show it\n4 5 6\n", XYZ)
    assert error.cause == "truncated"
    assert "2 rows" in str(error)


def test_places_far_into_a_file(tmp_path: Path) -> None:
    """Row and offset count on across the chunks in which the file is read."""
    rows = 60_000
    fields = [column(name, "F4", [0.0] * rows) for name in "xyz"]
    lines = [b"%d.5 %d -%d" % (row, row * 3, row) for row in range(rows)]
    found, _ = read(tmp_path, b"\n".join(lines), fields, block_points=7001)
    expected = np.array([[row + 0.5, row * 3, -row] for row in range(rows)], np.float32)
    assert np.array_equal(np.array(found["xyz"], np.float32), expected)
    lines[55_555] = b"1 2 x"
    error = refused(tmp_path, b"\n".join(lines), fields)
    assert "row 55556:" in str(error)
    assert error.offset == len(header(fields, "ascii")) + sum(len(line) + 1 for line in lines[:55_555])


def test_a_line_without_end(tmp_path: Path) -> None:
    error = refused(tmp_path, b"1" * 3_000_000, XYZ)
    assert error.cause == "bad_row"
    assert "longer than" in str(error)


def test_long_numbers_and_many_spaces(tmp_path: Path) -> None:
    text = b"1" + b"0" * 300 + b"e-300" + b" " * 5000 + b"2 3\n4 5 6\n" + b"\t" * 400_000 + b"7 8 9\n"
    found, _ = read(tmp_path, text, XYZ)
    assert found["xyz"] == [[1, 2, 3], [4, 5, 6], [7, 8, 9]]

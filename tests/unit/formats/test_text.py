# SPDX-License-Identifier: Apache-2.0
"""Text clouds: every column kept, separators understood or named, counts compared, errors with their line."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest

from shmmap.dividing.divide import divide
from shmmap.dividing.settings import DivideSettings
from shmmap.errors import MapDataError
from shmmap.formats.cloud import describe, read_cloud
from shmmap.formats.text_reader import TextReader

ROWS = [(589500.123456789, 2.0, 3.0, 0.5, 255, 128, 64), (1.0, -2.0, 3.5, 0.25, 1, 2, 3)]


def written(path: Path, text: str | bytes) -> Path:
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def rows(count: int, separator: str = " ") -> str:
    return "".join(separator.join(repr(value) for value in row[:count]) + "\n" for row in ROWS)


@pytest.mark.parametrize("separator", [" ", "\t", ",", ";", ", ", " ; ", "   "])
@pytest.mark.parametrize("suffix", [".xyz", ".txt", ".csv", ".asc"])
def test_separators(tmp_path: Path, separator: str, suffix: str) -> None:
    cloud = read_cloud(written(tmp_path / f"a{suffix}", rows(4, separator)))
    assert cloud.xyz.tolist() == [list(row[:3]) for row in ROWS]
    assert cloud.columns["intensity"].tolist() == [0.5, 0.25]
    assert cloud.warnings == ("no header names the columns: after x, y and z they are taken as intensity",)


@pytest.mark.parametrize(
    ("name", "text", "columns", "guessed"),
    [
        ("a.xyz", rows(3), [], False),
        ("a.xyz", rows(4), ["intensity"], True),
        ("a.xyz", rows(5), ["column_4", "column_5"], True),
        ("a.xyz", "1 2 3 255 128 64\n", ["red", "green", "blue"], True),
        ("a.xyz", "1 2 3 0.6 0 -0.8\n4 5 6 0 0 1\n", ["nx", "ny", "nz"], True),
        ("a.xyzn", "1 2 3 0 0 1\n", ["nx", "ny", "nz"], False),
        ("a.xyzrgb", "1 2 3 0.6 0 0.8\n", ["red", "green", "blue"], False),
        ("a.pts", "2\n" + rows(7), ["intensity", "red", "green", "blue"], True),
        ("a.txt", "//X Y Z I R G B\n" + rows(7), ["I", "R", "G", "B"], False),
        ("a.xyz", "# x y z intensity\n" + rows(4), ["intensity"], False),
        ("a.xyz", "# made by hand\n# x y z ring\n# in the map frame\n" + rows(4), ["ring"], False),
        ("a.csv", "x,y,z,ring,t\n" + rows(5, ","), ["ring", "t"], False),
        ("a.csv", '"X [m]","Y [m]","Z [m]","Gps Time"\n' + rows(4, ","), ["Gps_Time"], False),
        ("a.csv", "x;y;z;ring\n" + rows(4, ";"), ["ring"], False),
        ("a.csv", "X,Y,Z,ring,\n" + rows(4, ",").replace("\n", ",\n"), ["ring"], False),
        ("a.csv", "\ufeffx,y,z,r\r\n" + rows(4, ",").replace("\n", "\r\n"), ["r"], False),
        ("a.asc", "% columns\n" + rows(3) + "\n\n# the end\n", [], False),
        ("a.xyz", "2\n" + rows(4), ["intensity"], True),
        ("a.txt", rows(4).replace("\n", "\r"), ["intensity"], True),
        ("a.xyz", rows(4)[:-1], ["intensity"], True),
        ("\udcff.pts", "2\n" + rows(4), ["intensity"], True),  # a name that is not UTF-8
    ],
)
def test_columns_are_named(tmp_path: Path, name: str, text: str, columns: list[str], guessed: bool) -> None:
    cloud = read_cloud(written(tmp_path / name, text))
    assert list(cloud.columns) == ["xyz", *columns]
    assert bool(cloud.warnings) == guessed
    if guessed:
        assert ", ".join(columns) in cloud.warnings[0]
    if len(cloud.xyz) == 2 and columns[:1] != ["nx"]:
        for place, column in enumerate(columns, 3):
            assert cloud.columns[column].tolist() == [row[place] for row in ROWS]
    described = describe(tmp_path / name)
    assert (described.format, described.points) == (name[2:], cloud.points)
    assert [spec.name for spec in described.columns] == ["xyz", *columns]
    assert described.warnings == cloud.warnings


def test_a_header_may_put_the_coordinates_anywhere(tmp_path: Path) -> None:
    cloud = read_cloud(written(tmp_path / "a.csv", "time,Z,X,Y\n0.5,3,1,2\n1.5,6,4,5\n"))
    assert cloud.xyz.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert cloud.columns["time"].tolist() == [0.5, 1.5]


@pytest.mark.parametrize(
    ("name", "text", "cause", "words", "offset"),
    [
        ("a.xyz", "", "empty_file", "0 bytes", 0),
        ("a.xyz", "hello\n", "bad_row", "'hello' is not a row of numbers", 0),
        ("a.xyz", "hello\nworld\n", "bad_row", "'world' is not a row of numbers", 6),
        ("a.xyz", "1 2\n3 4\n", "no_xyz", "2 values", 0),
        ("a.xyz", "1 2 3\n4 5\n6 7 8\n", "bad_row", "line 2: 2 values, 3 are needed", 6),
        ("a.xyz", "# c\n1 2 3\n\n4 5 zero\n", "bad_row", "line 4: 'zero' is not a number", 11),
        ("a.xyz", "1 2 3\n4 5 1_0\n", "bad_row", "line 2: '1_0' is not a number", 6),
        ("a.xyz", "1,5 2,5 3,5\n", "bad_row", "two kinds of separators", 0),
        ("a.csv", "1,5;2,5;3,5\n", "bad_row", "two kinds of separators", 0),
        ("a.csv", "1,2,3,4\n1,2,,4\n", "bad_row", "line 2: '1,2,,4' is not 4 values separated by ','", 8),
        ("a.csv", "1,2,3\n1,2 3\n", "bad_row", "line 2: '1,2 3' is not 3 values", 6),
        ("a.csv", "1,2,3\n1;2;3\n", "bad_row", "line 2", 6),
        ("a.csv", "1,,2,3\n", "bad_row", "empty value", 0),
        ("a.csv", "azimuth,elevation,range\n1,2,3\n", "bad_header", "x, y and z", 0),
        ("a.csv", "x,y,z,i\n1,2,3\n", "bad_header", "names no 3 columns", 0),
        ("a.csv", "x,y,z,x\n1,2,3,4\n", "bad_header", "names no 4 columns", 0),
        ("a.csv", b"\xff\xfex\x00", "bad_row", "UTF-16", 0),
        ("a.pts", "10\n1 2 3 4\n", "truncated", "announces 10 points, 1 lines", 11),
        ("a.pts", "1\n1 2 3 4\n5 6 7 8\n", "bad_header", "announces 1 points, 2 lines", 0),
        ("a.pts", "many\n1 2 3 4\n", "bad_header", "not the number of points", 5),
        ("a.pts", "1 2 3 4\n", "bad_header", "not the number of points", 0),
        ("a.txt", "# only\n" * 20_000, "bad_row", "no row of numbers within", 0),
        ("a.asc", "ncols 4\nnrows 2\n1 2 3 4\n", "bad_row", "'nrows 2' is not a row of numbers", 8),
        ("a.xyz", b"\x00" * 100, "bad_row", "is not a row of numbers", 0),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_with_its_place(
    tmp_path: Path, name: str, text: str | bytes, cause: str, words: str, offset: int
) -> None:
    with pytest.raises(MapDataError) as caught:
        read_cloud(written(tmp_path / name, text))
    assert (caught.value.cause, words in str(caught.value)) == (cause, True), str(caught.value)
    assert caught.value.offset == offset


@pytest.mark.parametrize("text", ["0\n", "# x y z\n"])
def test_no_points(tmp_path: Path, text: str) -> None:
    cloud = read_cloud(written(tmp_path / ("a.pts" if text == "0\n" else "a.xyz"), text))
    assert (cloud.points, cloud.xyz.shape) == (0, (0, 3))


def test_a_long_file_in_pieces_from_anywhere(tmp_path: Path) -> None:
    """Comments, blank lines and borders of what is read at a time fall anywhere."""
    rng = random.Random(3)
    lines, expected = ["x;y;z;n"], []
    for number in range(30_000):
        if rng.random() < 0.02:
            lines.append(rng.choice(("", "  ", "# a;b;;c", "// 1;2;3;4", "\t")))
        expected.append((rng.uniform(-9, 9), number / 8, 1.0, number))
        lines.append(";".join(map(repr, expected[-1])) + rng.choice(("", " ", "\r")))
    path = written(tmp_path / "a.csv", "\n".join(lines))
    with TextReader(path) as reader:
        assert reader.points == 30_000
        for start in (0, 1, 12_345, 29_999, 30_000):
            found = [block["n"] for block in reader.blocks(777, start)]
            assert np.concatenate([*found, []]).tolist() == list(range(start, 30_000))
    assert read_cloud(path).xyz[:, 0].tolist() == [row[0] for row in expected]
    path.write_text(path.read_text() + "\n1;2;3\n")
    with pytest.raises(MapDataError, match=f"line {len(lines) + 1}: '1;2;3' is not 4 values"):
        read_cloud(path)


def test_divided_with_every_column(tmp_path: Path) -> None:
    path = written(tmp_path / "a.txt", "//X Y Z I R G B\n" + rows(7))
    made = divide([path], tmp_path / "map", DivideSettings(durable=False, check=True))
    assert [name for name, _ in made.fields] == ["x", "y", "z", "I", "R", "G", "B"]
    made = divide([written(tmp_path / "b.xyz", rows(4))], tmp_path / "guessed", DivideSettings(durable=False))
    assert any("taken as intensity" in note for note in made.notes)


def test_tables_in_a_directory_are_not_taken_for_clouds(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    written(tmp_path / "in" / "README.txt", "hello\n")
    written(tmp_path / "in" / "a.xyz", rows(3))
    assert divide([tmp_path / "in"], tmp_path / "map", DivideSettings(durable=False)).points == 2

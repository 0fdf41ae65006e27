# SPDX-License-Identifier: Apache-2.0
"""The way ahead out of a file: poses, or a table with commas."""

from __future__ import annotations

from pathlib import Path

import pytest
from shmmap_clients.scans.route_file import read_route

from shmmap import MapDataError, MapMissing


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("way.tum", "# t x y z q\n1.0 1.5 -2 7 0 0 0 1\n2.0 3 4e1 7 0 0 0.7071068 0.7071068\n"),
        ("way.csv", "1.5,-2\n3,4e1\n"),
        ("way.CSV", "\ufeffx,y,z\n1.5,-2,7\n\n3, 40,\n"),
        ("way.csv", '# planned\n"z","y","x"\n7,-2,1.5 # here it begins\n7,40,3,\n'),
    ],
)
def test_places(tmp_path: Path, name: str, text: str) -> None:
    file = tmp_path / name
    file.write_text(text, encoding="utf-8")
    assert read_route(file).tolist() == [[1.5, -2.0], [3.0, 40.0]]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "no places"),
        ("x,y\n", "no places"),
        ("1,2\n3\n", "line 2: not `x,y`"),
        ("x,y\n1,2\n\n3,nan\n", "line 4: not `x,y`"),
        ("east,north\n1,2\n", "line 1: not `x,y`"),
        ("1 2\n", "line 1: not `x,y`"),
    ],
)
def test_what_is_no_route_is_refused(tmp_path: Path, text: str, said: str) -> None:
    file = tmp_path / "way.csv"
    file.write_text(text)
    with pytest.raises(MapDataError, match=said) as refused:
        read_route(file)
    assert str(file) in str(refused.value)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(MapMissing, match=r"way\.csv"):
        read_route(tmp_path / "way.csv")
    (tmp_path / "way.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(MapDataError, match="not a text file"):
        read_route(tmp_path / "way.csv")
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(MapDataError, match="directory"):
        read_route(tmp_path / "folder.csv")

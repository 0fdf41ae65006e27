# SPDX-License-Identifier: Apache-2.0
"""`shmmap inspect` of files and directories; and the verbs that make clouds, with fields chosen "
"and empty inputs."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from shmmap.cli.entry import main
from shmmap.formats.cloud import read_cloud
from shmmap.formats.pcd.writer import write_pcd
from tests.unit.conftest import Verb


def cloud(path: Path, corner: float, count: int = 10) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    steps = np.arange(count, dtype=np.float32)
    columns = {
        "x": steps + corner,
        "y": steps,
        "z": steps / 10,
        "intensity": steps,
        "ring": steps.astype("u2"),
    }
    write_pcd(path, columns)
    return path


def test_a_directory_is_a_line_a_file_and_totals(tmp_path: Path, verb: Verb) -> None:
    cloud(tmp_path / "map" / "a.pcd", 0)
    cloud(tmp_path / "map" / "inner" / "b.pcd", 100, 20)
    (tmp_path / "map" / "notes.txt").write_text("no cloud")
    lines = verb(["inspect", str(tmp_path / "map")]).out.splitlines()
    assert lines[0].split() == ["FILE", "FORMAT", "SIZE", "POINTS", "LEFT", "OUT", "X", "Y", "Z", "FIELDS"]
    assert re.match(
        r"a\.pcd\s+pcd binary\s.*\s10\s+0\s+0 \.\. 9\s+0 \.\. 9\s+0 \.\. 0\.9\s+x y z "
        "intensity ring",
        lines[1],
    )
    assert lines[2].startswith("inner/b.pcd ")
    assert [line.split(maxsplit=1) for line in lines[4:6]] == [["files", "2"], ["points", "30"]]
    assert "x       0.000 .. 119.000 m (119.000 m)" in lines
    found = json.loads(verb(["inspect", "--json", str(tmp_path / "map")]).out)
    assert (found["points"], found["dropped"], found["failed"]) == (30, 0, [])
    assert found["bounds"]["max"] == [119.0, 19.0, pytest.approx(1.9)]
    assert [Path(one["path"]).name for one in found["files"]] == ["a.pcd", "b.pcd"]
    alone = json.loads(verb(["inspect", "--json", str(tmp_path / "map" / "a.pcd")]).out)
    assert found["files"][0] == alone | {"path": found["files"][0]["path"]}


def test_a_broken_file_costs_itself(tmp_path: Path, verb: Verb) -> None:
    cloud(tmp_path / "a.pcd", 0)
    (tmp_path / "bad.pcd").write_bytes(b"\0" * 100)
    said = verb(["inspect", str(tmp_path)], 65)
    assert "a.pcd" in said.out
    assert "1, 1 that cannot be read" in said.out
    assert said.err.startswith("shmmap: ")
    assert "bad.pcd" in said.err
    (tmp_path / "none").mkdir()
    assert main(["inspect", str(tmp_path / "none")]) == 66


def test_nothing_in_it_is_said(tmp_path: Path, verb: Verb) -> None:
    empty = tmp_path / "only" / "empty.pcd"
    cloud(empty, 0, 0)
    for path, what in ((empty, "it has no points"), (empty.parent, "no finite point in 1 file")):
        assert verb(["inspect", str(path)], 1).err == f"shmmap: {path}: {what}\n"
        verb(["inspect", "--allow-empty", str(path)])
    write_pcd(empty, {axis: np.full(3, np.nan, np.float32) for axis in "xyz"})
    assert "none of its 3 points is finite" in verb(["inspect", str(empty)], 1).err
    for words in (
        ["divide", str(empty), str(tmp_path / "map")],
        ["divide", str(empty.parent), str(tmp_path / "map")],
    ):
        verb([*words, "--quiet"], 65)
    cloud(empty, 0, 0)
    assert "no point in any of the inputs" in verb(["merge", str(empty), str(tmp_path / "out.pcd")], 65).err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["only"]


def test_fields_are_chosen(tmp_path: Path, verb: Verb) -> None:
    cloud(tmp_path / "in" / "a.pcd", 0)
    words = ["divide", str(tmp_path / "in"), str(tmp_path / "map"), "--quiet", "--json"]
    made = json.loads(verb([*words, "--fields", "x,y,z", "--fields", "ring"]).out)
    assert [name for name, _ in made["fields"]] == ["x", "y", "z", "ring"]
    (cell,) = (tmp_path / "map" / "pointcloud_map.pcd").iterdir()
    columns = read_cloud(cell).columns
    assert list(columns) == ["xyz", "ring"]
    assert sorted(columns["ring"].tolist()) == list(range(10))
    for fields, said in (("x,y,intensity", "lack z"), ("x,y,z,colour", "no input has a field colour")):
        assert said in verb([*words, "--force", "--fields", fields], 2).err
    # what one input lacks is no hindrance if it is not wanted
    write_pcd(tmp_path / "in" / "b.pcd", {axis: np.ones(2, np.float32) for axis in "xyz"})
    assert main([*words, "--force"]) == 65
    assert main([*words, "--force", "--fields", "x,y,z"]) == 0


def test_a_check_says_that_it_passed(tmp_path: Path, verb: Verb) -> None:
    cloud(tmp_path / "a.pcd", 0)
    words = ["divide", str(tmp_path / "a.pcd"), str(tmp_path / "map"), "--quiet", "--force"]
    checked = verb([*words, "--check"]).out
    assert re.search(r"^check +passed: 10 points read back, each in its cell$", checked, re.MULTILINE)
    assert "\ncheck " not in verb(words).out

# SPDX-License-Identifier: Apache-2.0
"""Cells that were moved without their metadata are named: log, status, doctor, inspect, and in Python."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import shmmap
from shmmap import ShmmapWarning
from tests.process.conftest import DaemonFactory
from tests.support.command_line import Shmmap, Verbs, doctor, verb
from tests.support.daemon_process import DaemonProcess, until
from tests.support.divided_map import DividedMap, random_points

MOVED = "0_0.pcd"


def finding(one: DaemonProcess) -> Any:
    return doctor(one)[1]["map"]


def move(made: DividedMap, name: str, by: float) -> None:
    """Move a cell's points along x, and leave its entry in the metadata as it is."""
    columns = random_points(np.random.default_rng(4), made.corners[name], 300)
    columns["x"] += np.float32(by)
    made.write_cell(name, made.corners[name], columns)


def count(client: shmmap.Client) -> int:
    return int(client.stats().counters["cells_outside_box"])


def test_moved_cells_are_named_everywhere(
    daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path
) -> None:
    move(divided_map, MOVED, 1000.0)
    one = daemon(divided_map.root)
    with shmmap.connect(one.endpoint) as client:
        outside = f"{MOVED}: 300 of the cell's points lie outside its box"
        with pytest.warns(ShmmapWarning, match=outside) as caught:
            cells = client.around(0, 0, 30, wait=60).cells
        assert [warning.filename for warning in caught] == [__file__], "the line of the program's own call"
        assert len(cells) > 1
        assert count(client) == 1
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # once a cell
            del cells
            client.around(0, 0, 30)
            client.around(0, 0, 30, layers=["voxel(leaf=2.0)"], wait=60)
        exported = Shmmap(one, tmp_path).run("export", "--circle", "0,0,30", "-o", str(tmp_path / "all.pcd"))
        first, *more = exported.stderr.splitlines()
        assert first.startswith("shmmap: ")
        assert outside in first
        assert not any("Warning" in line or ".py" in line for line in [first, *more]), "the text alone"
        assert one.log.count("points outside the cell's box") == 1
        assert divided_map.id(MOVED) in one.log
        assert "1 cell with points outside the cell's box" in verb(one, "status")[1]
        assert (finding(one)["state"], "points of 1 cell lie outside" in finding(one)["fact"]) == (
            "warn",
            True,
        )
        said = f"{MOVED} has points outside its box x 0 .. 20, y 0 .. 20"
        assert said in Verbs(tmp_path)("inspect", divided_map.root)
        report = Verbs(tmp_path).json("inspect", divided_map.root)
        assert [Path(one["path"]).name for one in report["map"]["outside_box"]] == [MOVED]
        divided_map.change(MOVED, seed=5)  # the file is right again
        client.reload()
        client.around(0, 0, 30)
        assert count(client) == 0
    until(lambda: finding(one)["state"] == "ok")  # the statistics segment follows with the next beat


def test_known_after_a_warm_restart_and_gone_with_the_cell(
    daemon: DaemonFactory, divided_map: DividedMap
) -> None:
    move(divided_map, MOVED, -15.0)
    one = daemon(divided_map.root)
    with shmmap.connect(one.endpoint) as client, warnings.catch_warnings():
        warnings.simplefilter("ignore", ShmmapWarning)
        client.around(0, 0, 30)
    one.leave()
    one.start()
    with shmmap.connect(one.endpoint) as client:
        assert count(client) == 1
        divided_map.remove_cell(MOVED)
        divided_map.write_metadata()
        client.reload()
        client.around(0, 0, 10)
        assert count(client) == 0


def test_a_sound_map_says_nothing(served: DaemonProcess, divided_map: DividedMap, tmp_path: Path) -> None:
    with shmmap.connect(served.endpoint) as client, warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(client.around(0, 0, 100, wait=60).cells) == 36
        assert count(client) == 0
    assert "outside" not in served.log
    code, said = verb(served, "status")
    assert (code, "outside" in said) == (0, False)
    assert Verbs(tmp_path).json("inspect", divided_map.root)["map"]["outside_box"] == []

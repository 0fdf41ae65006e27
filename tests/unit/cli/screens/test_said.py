# SPDX-License-Identifier: Apache-2.0
"""Lines that verbs print: events, and cells that could not be had."""

from __future__ import annotations

import ast
import json
import re
from typing import Any

import pytest

from shmmap.cli import json_output
from shmmap.cli.screens.output import user_name
from shmmap.cli.verbs.look.tail import _print_json, _print_text
from shmmap.errors import CellError, LoadFailed, OverBudget
from shmmap.lacking import failure_lines
from shmmap.protocol import events as e
from shmmap.protocol.messages import Holder
from tests.support.daemon_process import ROOT


@pytest.mark.parametrize(
    ("event", "text"),
    [
        (e.LiveStarted(1, 2, 3, 2, 0), "2 live maps served"),
        (e.LiveStarted(1, 2, 3, 1, 40), "1 live map served, 40 chunks found in memory"),
        (e.LiveEnded(1, 2, 3, 1),
         "the live worker ended (1 time by now), and restarts"),
        (e.LiveProblem(1, 2, 3, "lidar", "chunk 0_0_0 cannot be saved: full"),
         "lidar: chunk 0_0_0 cannot be saved: full"),
        (e.LiveProblem(1, 2, 3, "lidar", ""), "lidar: chunks are loaded and saved again"),
        (e.LiveDamaged(1, 2, 3, "lidar", "3_-1_0: version 7 is missing"),
         "lidar: 3_-1_0: version 7 is missing"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_live_maps(capsys: pytest.CaptureFixture[str], event: Any, text: str) -> None:
    _print_text(event)
    _, _, said = capsys.readouterr().out.partition("  ")
    assert said == f"live      {text}\n"


@pytest.mark.parametrize(
    ("event", "text", "fields"),
    [
        (
            e.PrefetchMiss(1, 2, 3, 0xAB, 77, "planning", 4, "0_0.pcd", "points"),
            "miss planning, pid 77 had to wait for 4 cells, such as 0_0.pcd points",
            {"event": "prefetch_miss", "session": "00000000000000ab", "cells": 4},
        ),
        (
            e.Loaded(1, 2, 3, "0_0.pcd", "points", 4, 4096, 10, 5_000_000),
            "loaded 0_0.pcd points 4.0 KiB, 10 points, in 5.0 ms",
            {"event": "loaded", "ahead": False},
        ),
        (
            e.Loaded(1, 2, 3, "0_0.pcd", "points", 4, 4096, 10, 5_000_000, ahead=True),
            "loaded 0_0.pcd points 4.0 KiB, 10 points, in 5.0 ms, ahead of the clients",
            {"event": "loaded", "ahead": True},
        ),
        (e.LiveChanged(1, 2, 3, "lidar", 77), "", {"event": "live_changed", "map": "lidar", "change": 77}),
    ],
)
def test_events_as_text_and_as_json(
    capsys: pytest.CaptureFixture[str], event: Any, text: str, fields: dict[str, Any]
) -> None:
    """Changes of live maps are printed only as JSON."""
    _print_text(event)
    assert " ".join(capsys.readouterr().out.split()[1:]) == text
    _print_json(event)
    document = json.loads(capsys.readouterr().out)
    assert document | fields == document


FULL = "the budget of 1.0 MiB is in use"

NDT = Holder(0xAB, 42, 1000, "ndt", 900 << 10, 30, "python3")

ASKER = Holder(0xCD, 43, 1000, "shmmap", 0, 0, "shmmap")

UNKNOWN = Holder(0, 0, -1, "unknown", 2048, 1)


def refused(name: str, *holders: Holder, message: str = FULL) -> CellError:
    path = f"/map/{name}"
    return OverBudget(f"{path} (points): {message}", cell_id=path, layer="points", holders=holders)


def unreadable(reason: str) -> CellError:
    return LoadFailed(f"/map/bad.pcd (points): {reason}", cell_id="/map/bad.pcd", layer="points")


@pytest.mark.parametrize(
    ("failed", "lines"),
    [
        (
            [*(refused(f"{x}_0.pcd", NDT, ASKER, UNKNOWN) for x in range(36)), unreadable("cut off")],
            [
                f"failed: 36 cells (points): {FULL} [over_budget]: 0_0.pcd, 1_0.pcd, 2_0.pcd, ...",
                "  in use: 900 KiB in 30 cells by ndt, pid 42",
                "  in use: 2.0 KiB in 1 cell by a process that did not open them through the client library",
                "failed: /map/bad.pcd (points): cut off [load_failed]",
            ],
        ),
        (
            [refused("a.pcd", ASKER), refused("b.pcd"), refused("c.pcd", message="too large")],
            [
                f"failed: 2 cells (points): {FULL} [over_budget]: a.pcd, b.pcd",
                "failed: /map/c.pcd (points): too large [over_budget]",
            ],
        ),
        ([unreadable("/map/bad.pcd: cut off")], ["failed: /map/bad.pcd (points): cut off [load_failed]"]),
    ],
)
def test_one_line_a_cause_and_each_holder_once(failed: list[CellError], lines: list[str]) -> None:
    """A client that holds nothing is not listed; a path is printed once."""
    assert failure_lines(failed) == lines


def test_holders_in_json() -> None:
    assert json_output.Holder.of(NDT) == json_output.Holder(
        "00000000000000ab", 42, 1000, user_name(1000), "ndt", "python3", 30, 921600
    )


IN_GB = {"ros_bridge/cli.py", "ros_cells/point_cloud.py"}
"""Messages of ROS 2, whose largest has 2.147 GB; the option that limits them is in GB."""


def test_sizes_and_counts_are_written_alike() -> None:
    """KiB, MiB and GiB, and commas in thousands; the texts of `.ci/words.txt` are another matter."""
    otherwise = re.compile(r"\b[kMG]B\b|\d \d{3} \d{3}")
    for path in (*(ROOT / "shmmap").rglob("*.py"), *(ROOT / "clients/shmmap_clients").rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        if any(str(path).endswith(name) for name in IN_GB) or not otherwise.search(text):
            continue
        tree = ast.parse(text)
        prose = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in prose:
                assert not otherwise.search(node.value), (path, node.lineno)


def test_the_old_words_are_refused() -> None:
    words = (ROOT / ".ci/words.txt").read_text(encoding="utf-8")
    patterns = [line.rpartition(" #")[0].strip() for line in words.splitlines() if not line.startswith("#")]
    refused = re.compile(
        "|".join(f"(?<![a-z`])(?:{re.sub(r'[(][?]-i:', '(?:', one)})(?![a-z])" for one in patterns), re.I
    )
    gone, old = "zombie", "active"
    for text in (f"a {gone}", f"{gone}s", f"is_{gone}", f"{gone}_count", f"12 {old} cells", f"{old}_voxels"):
        assert refused.search(text), text
    for text in (
        "`zombie`",
        '"zombie"',
        "NAME.zombie",
        "bytes_zombie",
        "zombie_bytes",
        "total_active_cells",
        "retired",
    ):
        assert not refused.search(text), text

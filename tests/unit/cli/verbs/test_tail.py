# SPDX-License-Identifier: Apache-2.0
"""What `tail` says of live maps, and of cells on the way of clients."""

from __future__ import annotations

import json
from typing import Any

import pytest

from shmmap.cli.verbs.tail import _print_json, _print_text
from shmmap.protocol import events as e


@pytest.mark.parametrize(
    ("event", "told"),
    [
        (e.LiveStarted(1, 2, 3, 2, 0), "2 live maps served"),
        (e.LiveStarted(1, 2, 3, 1, 40), "1 live map served, 40 chunks found in memory"),
        (e.LiveEnded(1, 2, 3, 1),
         "the live worker ended (1 time by now), and is started anew"),
        (e.LiveProblem(1, 2, 3, "lidar", "chunk 0_0_0 cannot be saved: full"),
         "lidar: chunk 0_0_0 cannot be saved: full"),
        (e.LiveProblem(1, 2, 3, "lidar", ""), "lidar: chunks are loaded and saved again"),
        (e.LiveDamaged(1, 2, 3, "lidar", "3_-1_0: version 7 is missing"),
         "lidar: 3_-1_0: version 7 is missing"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_live_maps(capsys: pytest.CaptureFixture[str], event: Any, told: str) -> None:
    _print_text(event)
    _, _, said = capsys.readouterr().out.partition("  ")
    assert said == f"live      {told}\n"


def test_cells_that_a_client_had_to_wait_for(capsys: pytest.CaptureFixture[str]) -> None:
    late = e.PrefetchMiss(1, 2, 3, 0xAB, 77, "planning", 4, "0_0.pcd", "points")
    _print_text(late)
    said = " ".join(capsys.readouterr().out.split())
    assert said.endswith("miss planning, pid 77 had to wait for 4 cells, such as 0_0.pcd points")
    _print_json(late)
    told = json.loads(capsys.readouterr().out)
    assert (told["event"], told["session"], told["cells"]) == ("prefetch_miss", "00000000000000ab", 4)


@pytest.mark.parametrize("ahead", [False, True])
def test_cells_that_were_fetched_ahead(capsys: pytest.CaptureFixture[str], ahead: bool) -> None:
    loaded = e.Loaded(1, 2, 3, "0_0.pcd", "points", 4, 4096, 10, 5_000_000, ahead=ahead)
    _print_text(loaded)
    said = " ".join(capsys.readouterr().out.split())
    assert said.endswith("in 5.0 ms" + ", ahead of the clients" * ahead)
    _print_json(loaded)
    assert json.loads(capsys.readouterr().out)["ahead"] is ahead


def test_that_they_change_is_for_programs(capsys: pytest.CaptureFixture[str]) -> None:
    changed = e.LiveChanged(1, 2, 3, "lidar", 77)
    _print_text(changed)
    assert capsys.readouterr().out == ""
    _print_json(changed)
    told = json.loads(capsys.readouterr().out)
    assert (told["event"], told["map"], told["change"]) == ("live_changed", "lidar", 77)

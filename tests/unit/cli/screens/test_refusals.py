# SPDX-License-Identifier: Apache-2.0
"""Cells that could not be had: one line a cause, and who uses the memory, in units a person reads."""

from __future__ import annotations

from shmmap.cli.screens.refusals import holder_rows
from shmmap.errors import CellError, LoadFailed, OverBudget
from shmmap.lacking import failure_lines
from shmmap.protocol.messages import Holder

FULL = "the budget of 1.0 MiB is in use"
NDT = Holder(0xAB, 42, 1000, "ndt", 900 << 10, 30, "python3")
ASKER = Holder(0xCD, 43, 1000, "shmmap", 0, 0, "shmmap")
STRANGER = Holder(0, 0, -1, "unknown", 2048, 1)


def refused(name: str, *holders: Holder, message: str = FULL) -> CellError:
    path = f"/map/{name}"
    return OverBudget(f"{path} (points): {message}", cell_id=path, layer="points", holders=holders)


def test_one_line_a_cause_and_each_holder_once() -> None:
    failed: list[CellError] = [refused(f"{x}_0.pcd", NDT, ASKER, STRANGER) for x in range(36)]
    failed.append(LoadFailed("/map/bad.pcd (points): cut off", cell_id="/map/bad.pcd", layer="points"))
    assert failure_lines(failed) == [
        f"failed: 36 cells (points): {FULL} [over_budget]: 0_0.pcd, 1_0.pcd, 2_0.pcd, ...",
        "  in use: 900 KiB in 30 cells by ndt, pid 42",
        "  in use: 2.0 KiB in 1 cell by a process that did not open them through the client library",
        "failed: /map/bad.pcd (points): cut off [load_failed]",
    ]


def test_a_path_is_told_once() -> None:
    message = "/map/bad.pcd (points): /map/bad.pcd: cut off"
    failed = LoadFailed(message, cell_id="/map/bad.pcd", layer="points")
    assert failure_lines([failed]) == ["failed: /map/bad.pcd (points): cut off [load_failed]"]


def test_who_asks_is_no_holder_of_nothing() -> None:
    assert failure_lines([refused("a.pcd", ASKER)]) == [f"failed: /map/a.pcd (points): {FULL} [over_budget]"]


def test_different_causes_are_different_lines() -> None:
    lines = failure_lines([refused("a.pcd"), refused("b.pcd"), refused("c.pcd", message="too large")])
    assert len(lines) == 2
    assert "2 cells" in lines[0]


def test_holders_in_json() -> None:
    error = refused("a.pcd", NDT, STRANGER)
    assert holder_rows(error)[0] == {
        "session": "00000000000000ab", "pid": 42, "uid": 1000, "client": "ndt", "command": "python3",
        "cells": 30, "bytes": 921600,
    }  # fmt: skip

# SPDX-License-Identifier: Apache-2.0
"""The line that a long run shows: part, rate and time left."""

from __future__ import annotations

import io
import time

import pytest

from shmmap.cli.screens.work_progress import StageProgress
from tests.unit.cli.screens.conftest import Terminal


def test_part_rate_and_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    out = io.StringIO()
    progress = StageProgress(out)
    progress.stage("dividing", 4_000_000)
    progress.advance(0)
    now = 102.0
    progress.advance(1_000_000)
    assert progress.text(102.0) == "dividing   25%  1.0 of 4.0 M points  0.5 M/s  6.0 s left"
    assert progress.text(100.5) == "dividing   25%  1.0 of 4.0 M points"  # too early for a rate
    now = 115.0
    progress.advance(1_000_000)
    progress.stage("publishing", 0)
    progress.done(2)
    assert out.getvalue().splitlines() == [
        "dividing    0%  0.0 of 4.0 M points",
        "dividing   50%  2.0 of 4.0 M points  0.1 M/s  15.0 s left",
    ]


def test_a_stage_in_a_pipe_ends_with_all_of_it() -> None:
    out = io.StringIO()
    progress = StageProgress(out)
    progress.stage("merging", 3_000_000)
    progress.advance(3_000_000)
    progress.done(3_000_000)
    progress.done(3_000_000)
    assert out.getvalue().splitlines() == [
        "merging    0%  0.0 of 3.0 M points",
        "merging  100%  3.0 of 3.0 M points",
    ]


def test_few_points_are_counted_one_by_one() -> None:
    progress = StageProgress(io.StringIO())
    progress.stage("merging", 20_000)
    progress.advance(5_000)
    assert progress.text(time.monotonic()) == "merging   25%  5,000 of 20,000 points"


def test_what_a_resumed_run_finds_done_is_no_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    progress = StageProgress(io.StringIO())
    progress.stage("dividing", 10_000_000)
    progress.advance(6_000_000)
    now = 2.0
    progress.advance(2_000_000)
    assert progress.text(2.0) == "dividing   80%  8.0 of 10.0 M points  1.0 M/s  2.0 s left"


def test_one_line_on_a_terminal_and_none_when_quiet() -> None:
    out = Terminal()
    progress = StageProgress(out)
    progress.stage("dividing", 10)
    progress.advance(10)
    progress.done(10)
    assert out.getvalue().startswith("\rdividing    0%")
    assert out.getvalue().endswith("\r\x1b[K")
    assert "\n" not in out.getvalue()
    quiet = Terminal()
    progress = StageProgress(quiet, quiet=True)
    progress.stage("dividing", 10)
    progress.advance(10)
    progress.done(10)
    assert quiet.getvalue() == ""

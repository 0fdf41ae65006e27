# SPDX-License-Identifier: Apache-2.0
"""Plays scenes one after the other, and prints a table of what they came to."""

from __future__ import annotations

import os
import traceback
from collections.abc import Sequence

from tests.benchmarks.hostile import (
    files,
    layers,
    library,
    long_runs,
    operators,
    requests,
    segments,
    sessions,
)
from tests.benchmarks.hostile.report import LeftOut, Report
from tests.benchmarks.hostile.stage import SCENES, Scene, Stage

__all__ = ["every_scene", "play"]

_MODULES = (files, layers, library, long_runs, operators, requests, segments, sessions)
"""Importing them adds their scenes."""


def every_scene() -> dict[str, Scene]:
    """Return all scenes by name: rows of the findings in their order, then the long runs."""

    def place(name: str) -> tuple[bool, str, int]:
        is_row = name[1:].isdigit()
        return not is_row, name[0], int(name[1:]) if is_row else 0

    return {name: SCENES[name] for name in sorted(SCENES, key=place)}


def play(scenes: Sequence[Scene], stage: Stage) -> int:
    """Play; returns 1 if a limit did not hold."""
    reports = []
    for one in scenes:
        report = Report(one.row, one.sentence)
        report.begin()
        try:
            one.play(report, stage)
        except LeftOut as reason:
            report.left_out = str(reason)
        except Exception as error:
            traceback.print_exc()
            report.over.append(f"the scene itself: {type(error).__name__}: {error}".split("\n")[0])
        report.end()
        reports.append(report)
    print_table(reports)
    return int(any(report.over for report in reports))


def print_table(reports: Sequence[Report]) -> None:
    """Print one line a scene; times in ms, memory in MiB over idle."""
    print(f"\n{'scene':10} {'p99':>9} {'longest':>9} {'echo':>7} {'memory':>7} {'newcomers':>9}  verdict")
    for one in reports:
        cells = [one.figures.get(name, "-") for name in ("p99", "probe", "echo", "memory", "newcomers")]
        widths = (9, 9, 7, 7, 9)
        shown = " ".join(f"{cell:>{width}}" for cell, width in zip(cells, widths, strict=True))
        print(f"{one.row:10} {shown}  {one.verdict()}")
    print(f"load {os.getloadavg()[0]:.1f}")

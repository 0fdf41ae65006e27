# SPDX-License-Identifier: Apache-2.0
"""What ``shmmap demo`` shows while it runs: a live view on a terminal, a line per stage in a pipe."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from shmmap.cli.screens.output import format_bytes, format_duration
from shmmap.demo.consumer import TASKS

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.live import Live

    from shmmap.demo.demo_town import Progress
    from shmmap.demo.fleet import StepReport

__all__ = ["LiveProgress", "PlainProgress", "QuietProgress", "progress_for"]

_BAR_CHARACTERS = 36


class QuietProgress:
    """Shows nothing."""

    def stage(self, text: str, total: int) -> None:
        """A new stage begins."""

    def step(self, reports: Sequence[StepReport] = (), counters: dict[str, int] | None = None) -> None:
        """One step is done."""


class PlainProgress(QuietProgress):
    """One line per stage, written when it begins."""

    def stage(self, text: str, total: int) -> None:
        """A new stage begins."""
        del total
        print(f"{text} ...", flush=True)


class LiveProgress(QuietProgress):
    """A picture of the present stage that is drawn over and over."""

    def __init__(self, live: Live) -> None:
        self._live = live
        self._finished: list[str] = []
        self._text = ""
        self._total = self._done = 0
        self._started_s = 0.0
        self._reports: Sequence[StepReport] = ()
        self._counters: dict[str, int] | None = None

    def stage(self, text: str, total: int) -> None:
        """A new stage begins."""
        self._finish_stage()
        self._text, self._total, self._done = text, total, 0
        self._started_s = time.monotonic()
        self._reports, self._counters = (), None
        self._draw()

    def step(self, reports: Sequence[StepReport] = (), counters: dict[str, int] | None = None) -> None:
        """One step is done."""
        self._done += 1
        self._reports, self._counters = reports, counters
        self._draw()

    def close(self) -> None:
        """Leave only the list of finished stages on the screen."""
        self._finish_stage()
        self._text, self._reports, self._counters = "", (), None
        self._draw()

    def _finish_stage(self) -> None:
        if self._text and self._done == self._total:
            self._finished.append(f"{self._text}: {format_duration(time.monotonic() - self._started_s)}")

    def _draw(self) -> None:
        self._live.update(self._picture(), refresh=True)

    def _picture(self) -> RenderableType:
        from rich.console import Group
        from rich.progress_bar import ProgressBar
        from rich.table import Table
        from rich.text import Text

        parts: list[RenderableType] = [Text(f"  done  {line}", style="green") for line in self._finished]
        if self._text:
            bar = Table.grid(padding=(0, 1))
            bar.add_row(
                Text(f"  {self._text}"),
                ProgressBar(self._total, self._done, width=_BAR_CHARACTERS),
                Text(f"{self._done}/{self._total}"),
            )
            parts.append(bar)
        if self._reports:
            table = Table.grid(padding=(0, 2))
            for task, report in zip(TASKS, self._reports, strict=False):
                new = f"+{report.new}" if report.new else ""
                table.add_row(
                    Text(f"    {task}", style="bold"),
                    Text(f"{report.cells} cells {new}"),
                    Text(format_duration(report.complete_s), justify="right"),
                    Text(report.answer, style="cyan"),
                )
            parts.append(table)
        if self._counters is not None:
            count = self._counters
            parts.append(
                Text(
                    f"    shared memory: {count['cells_resident']} cells,"
                    f" {format_bytes(count['bytes_resident'] + count['bytes_zombie'])} of"
                    f" {format_bytes(count['budget_bytes'])}, {count['evictions']} evicted"
                )
            )
        return Group(*parts)


@contextlib.contextmanager
def progress_for(*, quiet: bool) -> Iterator[Progress]:
    """Choose what to show: nothing, lines, or a live view on a terminal that can do that."""
    if quiet:
        yield QuietProgress()
        return
    if not sys.stdout.isatty() or os.environ.get("TERM", "dumb") == "dumb":
        yield PlainProgress()
        return
    from rich.console import Console
    from rich.live import Live

    with Live(console=Console(highlight=False), auto_refresh=False, transient=False) as live:
        progress = LiveProgress(live)
        yield progress
        progress.close()

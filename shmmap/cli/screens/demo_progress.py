# SPDX-License-Identifier: Apache-2.0
"""What ``shmmap demo`` shows while it runs: a live view on a terminal, a line per stage in a pipe."""

from __future__ import annotations

import contextlib
import itertools
import os
import sys
import time
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Final

from shmmap.cli.screens.output import format_bytes, format_duration, print_line
from shmmap.demo.consumer import TASKS

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.live import Live
    from rich.table import Table

    from shmmap.demo.demo_town import Progress
    from shmmap.demo.fleet import StepReport

__all__ = ["LiveProgress", "PlainProgress", "QuietProgress", "progress_for"]

_ROWS: Final = 8  # of consumers on the screen
_PLAIN_EVERY_S: Final = 10.0


class QuietProgress:
    """Shows nothing."""

    def stage(self, text: str, total: int) -> None:
        """A new stage begins."""

    def step(
        self, reports: Sequence[StepReport] = (), counters: dict[str, int] | None = None, note: str = ""
    ) -> None:
        """One step is done."""

    def event(self, text: str) -> None:
        """Something happened."""


class PlainProgress(QuietProgress):
    """A line per stage when it begins, one per event, and one every ten seconds of a long stage."""

    def __init__(self) -> None:
        self._total = self._done = 0
        self._told_s = 0.0

    def stage(self, text: str, total: int) -> None:
        """A new stage begins."""
        self._total, self._done, self._told_s = total, 0, time.monotonic()
        print_line(f"{text} ...", flush=True)

    def step(
        self, reports: Sequence[StepReport] = (), counters: dict[str, int] | None = None, note: str = ""
    ) -> None:
        """One step is done."""
        del reports, counters, note
        self._done += 1
        now_s = time.monotonic()
        if now_s - self._told_s >= _PLAIN_EVERY_S and self._done < self._total:
            self._told_s = now_s
            print_line(f"  step {self._done} of {self._total}", flush=True)

    def event(self, text: str) -> None:
        """Something happened."""
        print_line(f"  {text}", flush=True)


class LiveProgress(QuietProgress):
    """A picture of the present stage that is drawn over and over."""

    def __init__(self, live: Live) -> None:
        self._live = live
        self._finished: list[str] = []
        self._begin("", 0)

    def _begin(self, text: str, total: int) -> None:
        self._text, self._total, self._done = text, total, 0
        self._started_s = time.monotonic()
        self._reports: Sequence[StepReport] = ()
        self._counters: dict[str, int] | None = None
        self._event = ""

    def stage(self, text: str, total: int) -> None:
        """A new stage begins."""
        self._finish_stage()
        self._begin(text, total)
        self._draw()

    def step(
        self, reports: Sequence[StepReport] = (), counters: dict[str, int] | None = None, note: str = ""
    ) -> None:
        """One step is done."""
        self._done += 1
        self._reports, self._counters = reports, counters
        self._event = note or self._event
        self._draw()

    def event(self, text: str) -> None:
        """Something happened."""
        self._event = text
        self._draw()

    def close(self) -> None:
        """Leave only the list of finished stages on the screen."""
        self._finish_stage()
        self._begin("", 0)
        self._draw()

    def _finish_stage(self) -> None:
        if self._text and self._done >= self._total:
            self._finished.append(f"{self._text}: {format_duration(time.monotonic() - self._started_s)}")

    def _draw(self) -> None:
        self._live.update(self._picture(), refresh=True)

    def _picture(self) -> RenderableType:
        from rich.console import Group
        from rich.progress_bar import ProgressBar
        from rich.text import Text

        parts: list[RenderableType] = [Text(f"  done  {line}", style="green") for line in self._finished]
        if self._text:
            parts.append(Text(f"  {self._text}", style="bold"))
            bar = _grid()
            done = min(self._done, self._total)
            bar.add_row("", ProgressBar(self._total, done, width=40), f"{done}/{self._total}")
            parts.append(bar)
        if self._event:
            parts.append(Text(f"  {self._event}", style="yellow"))
        if self._reports:
            parts.append(self._consumers())
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

    def _consumers(self) -> RenderableType:
        """A row for each consumer: what it holds, reads and finds."""
        from rich.text import Text

        table = _grid()
        for task, report in itertools.islice(zip(itertools.cycle(TASKS), self._reports, strict=False), _ROWS):
            read = f"{report.counted / 1e6:.1f} M points read" if report.counted else ""
            table.add_row(
                Text(f"  {task}", style="bold"),
                Text(f"{report.cells} cells" + (f" +{report.new}" if report.new else "")),
                Text(read or f"{format_duration(report.complete_s):>8}"),
                Text(report.answer, style="cyan", overflow="ellipsis", no_wrap=True),
            )
        if len(self._reports) > _ROWS:
            table.add_row(Text(f"  and {len(self._reports) - _ROWS} more", style="bright_black"))
        return table


def _grid() -> Table:
    from rich.table import Table

    return Table.grid(padding=(0, 2))


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

# SPDX-License-Identifier: Apache-2.0
"""What ``shmmap demo`` shows while it runs: a live view on a terminal, a line per stage in a pipe."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Final

from shmmap.cli.screens.output import print_line
from shmmap.demo.progress import Progress

if TYPE_CHECKING:
    from rich.live import Live
    from rich.progress import TaskID

__all__ = ["LiveProgress", "PlainProgress", "progress_for"]

_PLAIN_EVERY_S: Final = 10.0
_BAR: Final = 12  # columns: the text of a stage, its numbers and its time fit beside it


class PlainProgress(Progress):
    """A line per stage when it begins, one per event, and one every ten seconds of a long stage."""

    def __init__(self) -> None:
        self._total = self._done = 0
        self._printed_s = 0.0

    def stage(self, text: str, total: int) -> None:
        """Print that a stage begins."""
        self._total, self._done, self._printed_s = total, 0, time.monotonic()
        print_line(f"{text} ...", flush=True)

    def step(self, *lines: str) -> None:
        """Print how far a long stage is."""
        del lines
        self._done += 1
        now_s = time.monotonic()
        if now_s - self._printed_s >= _PLAIN_EVERY_S and self._done < self._total:
            self._printed_s = now_s
            print_line(f"  step {self._done} of {self._total}", flush=True)

    def event(self, text: str) -> None:
        """Print what has happened."""
        print_line(f"  {text}", flush=True)


class LiveProgress(Progress):
    """A bar for each stage; below them the last event, and the lines of the last step."""

    def __init__(self, live: Live) -> None:
        from rich.progress import BarColumn, MofNCompleteColumn, TimeElapsedColumn
        from rich.progress import Progress as Bars

        self._live = live
        self._bars = Bars(
            "  {task.description}",
            BarColumn(_BAR),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            auto_refresh=False,
        )
        self._stage: TaskID | None = None
        self._event = ""

    def stage(self, text: str, total: int) -> None:
        """Draw a new bar."""
        self._stage, self._event = self._bars.add_task(text, total=total), ""
        self._draw()

    def step(self, *lines: str) -> None:
        """Draw the step and its lines."""
        if self._stage is not None:
            self._bars.advance(self._stage)
        self._draw(*lines)

    def event(self, text: str) -> None:
        """Draw the event until the stage ends, or until the next event."""
        self._event = text
        self._draw()

    def close(self) -> None:
        """Leave only the bars on the screen."""
        self._event = ""
        self._draw()

    def _draw(self, *lines: str) -> None:
        from rich.console import Group
        from rich.text import Text

        below = [Text(f"  {self._event}", style="yellow")] if self._event else []
        below += [Text(f"    {line}", style="cyan", overflow="ellipsis", no_wrap=True) for line in lines]
        self._live.update(Group(self._bars, *below), refresh=True)


@contextlib.contextmanager
def progress_for(*, quiet: bool) -> Iterator[Progress]:
    """Choose what to show: nothing, lines, or a live view on a terminal that can do that."""
    if quiet:
        yield Progress()
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

# SPDX-License-Identifier: Apache-2.0
"""What ``shmmap demo`` shows while it runs: a live view on a terminal, a line per stage in a pipe."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Final

from shmmap.cli.screens.output import format_duration, print_line
from shmmap.demo.progress import Progress

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.live import Live

__all__ = ["LiveProgress", "PlainProgress", "progress_for"]

_PLAIN_EVERY_S: Final = 10.0


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
    """A picture of the present stage that is drawn over and over, below a list of the finished ones."""

    def __init__(self, live: Live) -> None:
        self._live = live
        self._finished: list[str] = []
        self._begin("", 0)

    def _begin(self, text: str, total: int) -> None:
        self._text, self._total, self._done, self._began_s = text, total, 0, time.monotonic()
        self._lines: Sequence[str] = ()
        self._event = ""

    def stage(self, text: str, total: int) -> None:
        """Draw a new stage."""
        if self._text and self._done >= self._total:
            self._finished.append(f"{self._text}: {format_duration(time.monotonic() - self._began_s)}")
        self._begin(text, total)
        self._draw()

    def step(self, *lines: str) -> None:
        """Draw the step and its lines."""
        self._done += 1
        self._lines = lines
        self._draw()

    def event(self, text: str) -> None:
        """Draw the event until the stage ends, or until the next event."""
        self._event = text
        self._draw()

    def close(self) -> None:
        """Leave only the list of finished stages on the screen."""
        self.stage("", 0)

    def _draw(self) -> None:
        from rich.console import Group
        from rich.progress_bar import ProgressBar
        from rich.table import Table
        from rich.text import Text

        parts: list[RenderableType] = [Text(f"  done  {line}", style="green") for line in self._finished]
        if self._text:
            parts.append(Text(f"  {self._text}", style="bold"))
            bar = Table.grid(padding=(0, 2))
            done = min(self._done, self._total)
            bar.add_row("", ProgressBar(self._total, done, width=40), f"{done}/{self._total}")
            parts.append(bar)
        if self._event:
            parts.append(Text(f"  {self._event}", style="yellow"))
        parts += [
            Text(f"    {line}", style="cyan", overflow="ellipsis", no_wrap=True) for line in self._lines
        ]
        self._live.update(Group(*parts), refresh=True)


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

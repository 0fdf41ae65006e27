# SPDX-License-Identifier: Apache-2.0
"""Progress of long runs over clouds on stderr, and their results."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final, TextIO

from shmmap.cli.screens.output import format_bytes, format_duration, print_json, print_pairs

if TYPE_CHECKING:
    from shmmap.dividing.merge import MergedCloud
    from shmmap.origin.map_report import DividedMap

_REDRAW_S: Final = 0.2

_LINE_S: Final = 10.0  # seconds between lines where output is not a terminal

_SETTLE_S: Final = 1.0  # seconds before a rate is worth showing


class StageProgress:
    """Shows stage, fraction done, rate and time left; a `shmmap.dividing.settings.Progress`.

    Parameters
    ----------
    stream
        Output stream; stderr by default.
    quiet
        Show nothing.
    unit, scale
        The unit of the counts, and the count that is shown as 1; a smaller stage is shown one by one.
    """

    def __init__(
        self,
        stream: TextIO | None = None,
        *,
        quiet: bool = False,
        unit: str = "M points",
        scale: float = 1e6,
    ) -> None:
        self._stream = stream or sys.stderr
        self._live = self._stream.isatty()
        self._quiet = quiet
        self._units = (unit.removeprefix("M "), 1.0, 0), (unit, scale, 1 if scale > 1 else 0)
        self._unit, self._scale, self._digits = self._units[1]
        self._began_s = time.monotonic()
        self._name = ""
        self._total = self._points = self._shown = self._counted_from = 0
        self._stage_s = self._shown_s = self._began_s

    def stage(self, name: str, total: int) -> None:
        """Begin a stage."""
        self._end_line()
        self._name, self._total, self._points, self._counted_from = name, total, 0, -1
        self._unit, self._scale, self._digits = self._units[total >= self._units[1][1]]
        self._shown = 0
        self._stage_s = self._shown_s = time.monotonic()
        if total:
            self._show()

    def advance(self, points: int) -> None:
        """Count further points of the stage as done."""
        self._points += points
        if self._counted_from < 0:
            self._counted_from = self._points  # points that a resumed run finds done would falsify the rate
        now = time.monotonic()
        if now - self._shown_s >= (_REDRAW_S if self._live else _LINE_S):
            self._shown_s = now
            self._show()

    def done(self, points: int) -> None:
        """Finish the stage."""
        del points
        self._end_line()
        self._total = 0

    def text(self, now: float) -> str:
        """Return the progress line at time ``now`` (`time.monotonic`)."""
        part = f"{self._points / self._total:4.0%}  " if self._total else ""
        text = f"{self._name}  {part}{self._number(self._points)} of {self._number(self._total)} {self._unit}"
        spent = now - self._stage_s
        if spent < _SETTLE_S or self._points <= self._counted_from or self._points >= self._total:
            return text
        rate = (self._points - max(0, self._counted_from)) / spent
        left = (self._total - self._points) / rate
        return (
            f"{text}  {rate / self._scale:.1f}{' M' if self._digits else ''}/s  {format_duration(left)} left"
        )

    def _number(self, count: float) -> str:
        return f"{count / self._scale:,.{self._digits}f}"

    def _show(self) -> None:
        if self._quiet:
            return
        self._shown = self._points
        text = self.text(time.monotonic())
        if self._live:
            self._stream.write(f"\r{text}\x1b[K")
        else:
            self._stream.write(text + "\n")
        self._stream.flush()

    def _end_line(self) -> None:
        if not self._live and self._total and self._points >= self._total and self._shown < self._total:
            self._show()
        if self._live and self._name and not self._quiet:
            self._stream.write("\r\x1b[K")
            self._stream.flush()


def fields_text(fields: Sequence[tuple[str, str]]) -> str:
    """Return (name, dtype) pairs as text: ``"x:f4 y:f4 z:f4"``."""
    return " ".join(f"{name}:{dtype.lstrip('<|')}" for name, dtype in fields)


def print_result(
    made: DividedMap | MergedCloud, lines: Sequence[tuple[str, str]], *, seconds: float, as_json: bool
) -> None:
    """Print the result ``made`` as JSON, or ``lines`` about it; with the run's time and memory."""
    from shmmap.dividing.settings import peak_memory_bytes

    peak = peak_memory_bytes()
    if as_json:
        from shmmap.cli.json_output import with_more

        print_json(with_more(made, seconds=seconds, peak_memory_bytes=peak))
    else:
        print_pairs([*lines, ("time", format_duration(seconds)), ("peak memory", format_bytes(peak))])

# SPDX-License-Identifier: Apache-2.0
"""Output of ``shmmap demo``: progress, and the measured results as text or JSON."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import shutil
import sys
import textwrap
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Final

from shmmap.cli.screens.output import (
    Column,
    format_bytes,
    format_duration,
    print_line,
    print_table,
    printable,
)
from shmmap.demo.program import Progress

if TYPE_CHECKING:
    from shmmap.demo.demo import DemoResult

_EVERY_S: Final = 10.0


class DemoProgress(Progress):
    """Prints stages and events, and how far a long stage is.

    That is a line every ten seconds; on a terminal it is drawn again at each step, with the step's lines.
    """

    def __init__(self) -> None:
        self._is_live = sys.stdout.isatty() and os.environ.get("TERM", "dumb") != "dumb"
        self._total = self._done = self._drawn = 0
        self._printed_s = 0.0

    def stage(self, text: str, total: int) -> None:
        """Print that a stage begins."""
        self._total, self._done, self._printed_s = total, 0, time.monotonic()
        self._print(f"{text} ...")

    def step(self, *lines: str) -> None:
        """Show the progress of the stage."""
        self._done += 1
        text = f"  step {self._done} of {self._total}"
        if self._is_live:
            width = shutil.get_terminal_size().columns - 1
            shown = [text, *(f"    {line}" for line in lines)]
            self._print(*(printable(line)[:width] for line in shown))
            self._drawn = len(shown)
        elif (now_s := time.monotonic()) - self._printed_s >= _EVERY_S and self._done < self._total:
            self._printed_s = now_s
            self._print(text)

    def event(self, text: str) -> None:
        """Print an event."""
        self._print(f"  {text}")

    def clear(self) -> None:
        """Remove what was drawn of the last step."""
        sys.stdout.write(f"\x1b[{self._drawn}A\x1b[J" if self._drawn else "")
        self._drawn = 0

    def _print(self, *lines: str) -> None:
        self.clear()
        for line in lines:
            print_line(line, flush=True)


@contextlib.contextmanager
def progress_for(*, quiet: bool) -> Iterator[Progress]:
    """Return the progress display."""
    if quiet:
        yield Progress()
        return
    progress = DemoProgress()
    yield progress
    progress.clear()


_WIDTH: Final = 79  # columns of the longest line

_NARROWEST: Final = 30

_NAMES: Final = 10  # columns before the lines

_COLUMNS: Final = ("PROCESSES", "MEMORY", "CPU TIME", "FIRST MAP", "LOOP HELD UP")


def print_report(result: DemoResult, picture: str, duration_s: float) -> None:
    """Print the table, then each line after its name; no wider than a page, also in a pipe."""
    print_line()
    columns = [Column(name, "right" if number else "left") for number, name in enumerate(_COLUMNS)]
    print_table(columns, _rows(result))
    print_line()
    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else _WIDTH
    duration = f"{format_duration(duration_s)}; picture: {picture}"
    for name, text in {**_lines(result), "duration": duration}.items():
        for line in textwrap.wrap(
            text,
            max(min(width, _WIDTH), _NARROWEST),
            initial_indent=f"{name:{_NAMES}}",
            subsequent_indent=" " * _NAMES,
            break_long_words=False,
            break_on_hyphens=False,
        ):
            print_line(line)


def _rows(result: DemoResult) -> list[list[str]]:
    """Return the table's rows: memory and times with one shared copy of the map, and with private ones."""
    rows = []
    for each in result.rounds:
        copies = "private copies" if each.consumers > 1 else "private copy"
        for name, drive in ((copies, each.private), ("with shmmap", each.shared)):
            seconds = (drive.cpu_s, drive.start_s, drive.follow_max_s)
            rows.append(
                [f"{each.consumers} {name}", format_bytes(drive.total_bytes), *map(format_duration, seconds)]
            )
    return rows


def demo_document(result: DemoResult) -> dict[str, Any]:
    """Return what ``--json`` prints, but for the pictures and the duration."""
    town, found = result.town, result.localization
    more_shared, more_private = result.one_more_bytes
    return {
        "town": {
            "cells": town.cells,
            "points": town.points,
            "file_bytes": town.file_bytes,
            "build_s": town.build_s,
        },
        "rounds": [dataclasses.asdict(each) for each in result.rounds],
        "one_more_bytes": {"shared": more_shared, "private": more_private},
        "outage": dataclasses.asdict(result.outage),
        "localization": dataclasses.asdict(found) if found else None,
    }


def _lines(result: DemoResult) -> dict[str, str]:
    town, out, found = result.town, result.outage, result.localization
    last = result.rounds[-1]
    count, shared, private = last.consumers, last.shared, last.private
    more_shared, more_private = result.one_more_bytes
    pays = "" if result.pays_from is None else f"; less from {result.pays_from} processes on"
    if shared.total_bytes >= private.total_bytes:  # plus each process's fixed size
        pays = (
            f". The map around the vehicle ({format_bytes(shared.map_bytes)}) is too small to gain"
            " from sharing; --density 100 makes a larger one"
        )
    position = f"left out: the package {result.missing} is not installed"
    if found is not None:
        position = (
            f"{found.scans} LiDAR scans: {found.error_m * 100:.1f} cm off,"
            f" {found.error_max_m * 100:.1f} cm at most; first pose after"
            f" {format_duration(found.first_pose_s)} (kernels were compiled before)"
        )
    return {
        "town": (
            f"{town.cells} cells, {town.points / 1e6:.1f} million points; a process needs {shared.cells}"
            f" cells, {format_bytes(shared.map_bytes)}"
        ),
        "memory": (
            f"{count} processes, a private copy each: {format_bytes(private.total_bytes)}; with shmmap:"
            f" {format_bytes(shared.total_bytes)}{pays}"
        ),
        "one more": (
            f"each further process: {format_bytes(more_private)} with a copy, {format_bytes(more_shared)}"
            " with shmmap"
        ),
        "waiting": (
            f"a control loop waits up to {format_duration(private.follow_max_s)} for new cells; shmmap:"
            f" {format_duration(shared.follow_max_s)}"
        ),
        "CPU": (
            f"{count} copies: {format_duration(private.cpu_s)}; shmmap: {format_duration(shared.cpu_s)},"
            f" {format_duration(shared.daemon_start_cpu_s)} of it to start the daemon"
        ),
        "kill -9": (
            f"back in {format_duration(out.down_s)} with {out.adopted} of {out.segments} cells;"
            f" no process paused over {format_duration(out.longest_pause_s)}"
        ),
        "position": position,
    }


def draw_town(result: DemoResult) -> str:
    """Draw the town from above, with the route and the cells in shared memory, as SVG."""
    from shmmap.cli.screens.picture import CellSquare, Raster, Vehicle, top_view_svg

    town, shared = result.town, result.rounds[-1].shared
    states = {row.box: row for row in result.resident}
    cells = []
    for box in town.boxes:
        row = states.get(box)
        title = f"{box[0]:g}, {box[1]:g}" + (f": {row.points:,} points, {row.state}" if row else "")
        cells.append(CellSquare(box, row.state if row else "", title))
    end = town.route[-1]
    resident = sum(1 for cell in cells if cell.state == "resident")
    return top_view_svg(
        town.bounds,
        cells,
        title=f"A generated town: {town.cells} cells, {town.points / 1e6:.1f} million points",
        note=f"At the end of the drive {resident} cells are in shared memory, once for all"
        f" {shared.consumers} processes: {format_bytes(shared.shm_bytes)}.",
        raster=Raster(town.bounds, town.backdrop_png),
        driven=[(pose.x, pose.y) for pose in town.route],
        vehicle=Vehicle(end.x, end.y, end.heading, result.radius),
    )

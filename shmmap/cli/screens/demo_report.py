# SPDX-License-Identifier: Apache-2.0
"""What ``shmmap demo`` says in the end: a table of what was measured, and some lines of what it means."""

from __future__ import annotations

import shutil
import sys
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

from shmmap.cli.screens.output import Column, format_bytes, format_duration, print_line, print_table

if TYPE_CHECKING:
    from shmmap.demo.demo import DemoResult
    from shmmap.demo.drive import DriveResult
    from shmmap.demo.localization import LocalizationResult

__all__ = ["draw", "print_report", "print_texts"]

_WIDTH: Final = 79  # columns, of which every line has to make do
_NARROWEST: Final = 30
_NAMES: Final = 10  # columns, in front of the lines


def print_report(result: DemoResult, picture: str, duration_s: float) -> None:
    """Print the table and the lines."""
    print_line()
    _print_table(result)
    print_line()
    print_texts([*_lines(result), ("duration", f"{format_duration(duration_s)}; picture: {picture}")])


def print_texts(texts: Sequence[tuple[str, str]]) -> None:
    """Print texts, each with its name in front; in a pipe, too, lines of a page's width."""
    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else _WIDTH
    for name, text in texts:
        for line in textwrap.wrap(
            text,
            max(min(width, _WIDTH), _NARROWEST),
            initial_indent=f"{name:{_NAMES}}",
            subsequent_indent=" " * _NAMES,
            break_long_words=False,
            break_on_hyphens=False,
        ):
            print_line(line)


def _print_table(result: DemoResult) -> None:
    rows = []
    for count, each in result.rounds.items():
        copies = "private copies" if count > 1 else "private copy"
        rows += [_row(f"{count} {copies}", each.private), _row(f"{count} with shmmap", each.shared)]
    columns = ("PROCESSES", "MEMORY", "CPU TIME", "FIRST MAP", "LOOP HELD UP")
    print_table([Column(name, "right" if number else "left") for number, name in enumerate(columns)], rows)


def _row(name: str, drive: DriveResult) -> list[str]:
    return [
        name,
        format_bytes(drive.total_bytes),
        format_duration(drive.cpu_s),
        format_duration(drive.start_s),
        format_duration(drive.follow_max_s),
    ]


def _lines(result: DemoResult) -> list[tuple[str, str]]:
    lines = [
        ("town", _town(result)),
        ("memory", _memory(result)),
        ("one more", _one_more(result)),
        ("waiting", _waiting(result)),
        ("CPU", _cpu(result)),
        ("kill -9", _outage(result)),
    ]
    if result.programs is not None:
        document = result.programs.document
        return [
            *lines,
            ("position", _all_positions(document)),
            ("moving", _moving(document["errors"]["compare"])),
            ("ground", _ground(document["errors"]["elevation"])),
        ]
    found = result.localization
    if found is None:
        return [*lines, ("position", f"left out: the package {result.missing} is not installed")]
    return [*lines, ("position", _position(found))]


def _town(result: DemoResult) -> str:
    town, one = result.town, result.many.shared
    return (
        f"{town.cells} cells, {town.points / 1e6:.1f} million points; a process needs {one.cells} cells,"
        f" {format_bytes(one.map_bytes)}"
    )


def _memory(result: DemoResult) -> str:
    count = max(result.rounds)
    last = result.rounds[count]
    return (
        f"{count} processes, a private copy each: {format_bytes(last.private.total_bytes)}; with shmmap:"
        f" {format_bytes(last.shared.total_bytes)}{_too_small(result)}"
    )


def _too_small(result: DemoResult) -> str:
    """Say why sharing saves nothing where the map is sparse: every process also has a fixed size."""
    last = result.rounds[max(result.rounds)]
    if last.shared.total_bytes < last.private.total_bytes:
        return ""
    return (
        f". The map around the vehicle ({format_bytes(last.shared.map_bytes)}) is too small to gain"
        " from sharing; --density 100 makes a larger one"
    )


def _one_more(result: DemoResult) -> str:
    shared_bytes, private_bytes = result.one_more_bytes
    return (
        f"each further process: {format_bytes(private_bytes)} with a copy, {format_bytes(shared_bytes)}"
        " with shmmap"
    )


def _waiting(result: DemoResult) -> str:
    shared, private = result.many.shared, result.many.private
    return (
        f"a control loop waits up to {format_duration(private.follow_max_s)} for new cells; shmmap:"
        f" {format_duration(shared.follow_max_s)}"
    )


def _cpu(result: DemoResult) -> str:
    count = max(result.rounds)
    last = result.rounds[count]
    return (
        f"{count} copies: {format_duration(last.private.cpu_s)}; shmmap:"
        f" {format_duration(last.shared.cpu_s)}, {format_duration(last.shared.daemon_start_cpu_s)} of it"
        " to start the daemon"
    )


def _outage(result: DemoResult) -> str:
    out = result.outage
    return (
        f"back in {format_duration(out.down_s)} with {out.adopted} of {out.segments} cells;"
        f" no process paused over {format_duration(out.longest_pause_s)}"
    )


def _position(found: LocalizationResult) -> str:
    return (
        f"{found.scans} LiDAR scans: {_cm(found.error_m)} off, {_cm(found.error_max_m)} at most;"
        f" first pose after {format_duration(found.first_pose_s)}"
    )


def _all_positions(document: dict[str, Any]) -> str:
    errors = document["errors"]["ndt"]
    return (
        f"{document['programs']['ndt']['frames']} of {document['scans']} LiDAR scans localized:"
        f" {_cm(errors['mean_m'])} off on average, {_cm(errors['max_m'])} at most"
    )


def _moving(errors: dict[str, float]) -> str:
    return (
        f"shmmap-compare kept {errors['moving_kept']:.0%} of points on cars and people,"
        f" {errors['still_kept']:.1%} of others"
    )


def _ground(errors: dict[str, Any]) -> str:
    return (
        f"shmmap-elevation: road height {_cm(errors['mean_m'])} off on average, {_cm(errors['max_m'])}"
        " at most"
    )


def _cm(metres: float | None) -> str:
    return "unknown" if metres is None else f"{metres * 100:.1f} cm"


def draw(result: DemoResult) -> str:
    """Draw the town from above, with the way and the cells in shared memory, as SVG."""
    from shmmap.cli.screens.picture import CellSquare, Raster, Vehicle, top_view_svg

    town = result.town
    states = {row.box: row for row in result.resident}
    cells = []
    for box in town.boxes:
        row = states.get(box)
        title = f"{box[0]:g}, {box[1]:g}" + (f": {row.points:,} points, {row.state}" if row else "")
        cells.append(CellSquare(box, row.state if row else "", title))
    last = town.route[-1]
    resident = sum(1 for cell in cells if cell.state == "resident")
    return top_view_svg(
        town.bounds,
        cells,
        title=f"A generated town: {town.cells} cells, {town.points / 1e6:.1f} million points",
        note=f"At the end of the drive {resident} cells are in shared memory, once for all"
        f" {result.many.shared.consumers} processes: {format_bytes(result.many.shared.shm_bytes)}.",
        raster=Raster(town.bounds, town.picture_png),
        driven=[(pose.x, pose.y) for pose in town.route],
        vehicle=Vehicle(last.x, last.y, last.heading, result.settings.radius),
    )

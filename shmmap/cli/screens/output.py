# SPDX-License-Identifier: Apache-2.0
"""How verbs print: aligned text, a table on a terminal, or JSON."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import sys
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

__all__ = [
    "Column",
    "columns_that_fit",
    "format_bytes",
    "format_duration",
    "print_json",
    "print_pairs",
    "print_table",
    "wants_style",
]

_NARROWEST: Final = 20  # columns that text needs to be worth breaking


@dataclass(frozen=True, slots=True)
class Column:
    """One column of a table; numbers are aligned right.

    A terminal too narrow for the table goes without the columns that are ``spare``, highest first.
    """

    name: str
    align: Literal["left", "right"] = "left"
    spare: int = 0


def print_json(value: object) -> None:
    """Print one JSON document; a number JSON cannot hold (NaN, infinity) is a defect."""
    indent = 2 if sys.stdout.isatty() else None
    json.dump(value, sys.stdout, indent=indent, allow_nan=False, ensure_ascii=False)
    sys.stdout.write("\n")


def print_table(columns: Sequence[Column], rows: Sequence[Sequence[str]]) -> None:
    """Print rows under headings: ruled and coloured on a terminal, plain and aligned in a pipe."""
    if wants_style() and importlib.util.find_spec("rich") is not None:  # a client-only install lacks it
        _print_rich(columns, rows)
        return
    cells = [[column.name for column in columns], *rows]
    widths = [max(map(len, texts)) for texts in zip(*cells, strict=True)]
    # one format for the whole line: thousands of rows are printed in the time of an eye's blink
    line = "  ".join(
        f"{{:{'>' if column.align == 'right' else '<'}{width}}}"
        for column, width in zip(columns, widths, strict=True)
    )
    print("\n".join([line.format(*row).rstrip() for row in cells]))


def wants_style() -> bool:
    """Whether to print colours: on a terminal that can, unless NO_COLOR says not to."""
    return sys.stdout.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"


def _print_rich(columns: Sequence[Column], rows: Sequence[Sequence[str]]) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console(highlight=False)
    shown = columns_that_fit(columns, rows, console.width)
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, header_style="bold")
    for index in shown:
        # only the first column, a name, may be folded: numbers in pieces tell nothing
        column = columns[index]
        table.add_column(column.name, justify=column.align, overflow="fold", no_wrap=index > 0)
    for row in rows:
        table.add_row(*(Text(row[index]) for index in shown))
    console.print(table)
    if missing := [column.name for index, column in enumerate(columns) if index not in shown]:
        console.print(Text(f"no room for {', '.join(missing)}", style="bright_black"))


def columns_that_fit(
    columns: Sequence[Column], rows: Sequence[Sequence[str]], width: int, *, gap: int = 3
) -> list[int]:
    """Return the indices of all columns, without the most spare ones as far as ``width`` demands it."""
    widths = [max(map(len, texts)) for texts in zip([column.name for column in columns], *rows, strict=True)]
    shown = list(range(len(columns)))
    for level in sorted({column.spare for column in columns} - {0}, reverse=True):
        if sum(widths[index] + gap for index in shown) - gap <= width:
            break
        shown = [index for index in shown if columns[index].spare != level]
    return shown


def print_pairs(pairs: Sequence[tuple[str, str]]) -> None:
    """Print ``name  value`` lines with the values aligned; on a terminal long ones go on below themselves."""
    width = max((len(name) for name, _ in pairs), default=0)
    room = shutil.get_terminal_size().columns - width - 2 if sys.stdout.isatty() else 0
    for name, value in pairs:
        lines = [value]
        if len(value) > room >= _NARROWEST:
            lines = textwrap.wrap(value, room, break_long_words=False, break_on_hyphens=False)
        for number, line in enumerate(lines):
            print(f"{'' if number else name:{width}}  {line}".rstrip())


def format_bytes(count: float) -> str:
    """Return bytes for a reader, ``"4.1 KiB"`` or ``"103 MiB"``; powers of 1024, as ``--budget``."""
    value = float(count)
    for unit in ("B", "KiB", "MiB", "GiB"):
        if abs(value) < 1023.5 or unit == "GiB":
            break
        value /= 1024.0
    digits = 0 if unit == "B" or abs(value) >= 99.95 else 1
    return f"{value:.{digits}f} {unit}"


def format_duration(duration_s: float) -> str:
    """Return a time span for a reader: ``"12 us"``, ``"3.4 ms"``, ``"5.0 s"``, ``"3 min"``, ``"2 h"``."""
    if duration_s < 0.9995e-3:
        return f"{duration_s * 1e6:.0f} us"
    if duration_s < 0.9995:
        return f"{duration_s * 1e3:.1f} ms"
    if duration_s < 119.5:
        return f"{duration_s:.1f} s"
    if duration_s < 7170:
        return f"{duration_s / 60:.0f} min"
    if duration_s < 2 * 86400:
        return f"{duration_s / 3600:.0f} h"
    return f"{duration_s / 86400:.0f} d"

# SPDX-License-Identifier: Apache-2.0
"""How verbs print: aligned text, a table on a terminal, or JSON."""

from __future__ import annotations

import importlib.util
import json
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

__all__ = [
    "Column",
    "format_bytes",
    "format_duration",
    "print_json",
    "print_pairs",
    "print_table",
    "wants_style",
]


@dataclass(frozen=True, slots=True)
class Column:
    """One column of a table; numbers are aligned right."""

    name: str
    align: Literal["left", "right"] = "left"


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

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, header_style="bold")
    for column in columns:
        table.add_column(column.name, justify=column.align, overflow="fold")
    for row in rows:
        table.add_row(*(Text(text) for text in row))
    Console(highlight=False).print(table)


def print_pairs(pairs: Sequence[tuple[str, str]]) -> None:
    """Print ``name  value`` lines with the values aligned."""
    width = max((len(name) for name, _ in pairs), default=0)
    for name, value in pairs:
        print(f"{name.ljust(width)}  {value}".rstrip())


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

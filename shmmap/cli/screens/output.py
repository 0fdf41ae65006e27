# SPDX-License-Identifier: Apache-2.0
r"""Print what verbs show: lines, aligned text, tables on a terminal, or JSON.

All output of the verbs passes through this module.  Names of clients, processes, files and cells are not
trusted: a name may contain codes that move a terminal's cursor or rename its window.  So unprintable
characters are shown escaped (``\x1b``), in this one place.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final, Literal, NamedTuple, TextIO

from shmmap.quantities import counted, format_bytes, format_duration, format_metres

__all__ = [
    "Column",
    "columns_that_fit",
    "counted",
    "format_bytes",
    "format_duration",
    "format_metres",
    "json_text",
    "print_hanging",
    "print_json",
    "print_line",
    "print_pairs",
    "print_table",
    "printable",
    "rows_text",
    "user_name",
    "wants_style",
]


_EDGES: Final = 2  # blanks left and right of a table
_GAP: Final = 3  # blanks between columns

_NARROWEST: Final = 20  # columns that make breaking the text worthwhile


class Column(NamedTuple):
    """One column of a table; numbers are right-aligned.

    A terminal too narrow for the table shows only the ``spare`` columns that fit, lowest number first.
    ``looks`` maps words of the column to colours.
    """

    name: str
    align: Literal["left", "right"] = "left"
    spare: int = 0
    looks: Mapping[str, str] = MappingProxyType({})


def printable(text: str) -> str:
    r"""Return ``text`` with unprintable characters replaced by Python escapes, such as ``\x1b``.

    Unprintable are control and format characters, line breaks, and bytes of a file name that are no text.
    """
    if text.isprintable():
        return text
    return "".join(
        one if one.isprintable() else one.encode("unicode_escape", "surrogatepass").decode("ascii")
        for one in text
    )


def rows_text(count: int, layer: str) -> str:
    """Return ``"1,200 points"``, or ``"157 rows"`` for a layer whose rows are not points."""
    return counted(count, "point" if layer == "points" else "row")


def print_line(text: str = "", *, file: TextIO | None = None, flush: bool = False) -> None:
    """Print one line."""
    print(printable(text), file=file, flush=flush)


def json_text(value: object, *, indent: int | None = None) -> str:
    """Return a JSON document whose strings contain no control codes for terminals."""
    import json

    text = json.dumps(value, indent=indent, allow_nan=False, ensure_ascii=False)
    if text.replace("\n", "").isprintable():
        return text
    # outside strings JSON has no unprintable character but the line break
    return "".join(
        one if one == "\n" or one.isprintable() else json.dumps(one, ensure_ascii=True)[1:-1] for one in text
    )


def print_json(value: object) -> None:
    """Print a struct or plain values as one JSON document; NaN and infinity are not allowed."""
    if hasattr(value, "__struct_fields__"):
        import msgspec

        value = msgspec.to_builtins(value)
    sys.stdout.write(json_text(value, indent=2 if sys.stdout.isatty() else None) + "\n")


def print_table(columns: Sequence[Column], rows: Sequence[Sequence[str]]) -> None:
    """Print rows under headings: ruled and coloured on a terminal, plain and aligned in a pipe."""
    rows = [[printable(text) for text in row] for row in rows]
    if wants_style() and _has_rich():
        _print_rich(columns, rows)
        return
    cells = [[column.name for column in columns], *rows]
    widths = [max(map(len, texts)) for texts in zip(*cells, strict=True)]
    # one format for the whole line keeps thousands of rows fast
    line = "  ".join(
        f"{{:{'>' if column.align == 'right' else '<'}{width}}}"
        for column, width in zip(columns, widths, strict=True)
    )
    print("\n".join([line.format(*row).rstrip() for row in cells]))


def wants_style() -> bool:
    """Whether to print colours: stdout is a terminal that supports them, and NO_COLOR is not set."""
    return sys.stdout.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"


def _has_rich() -> bool:
    """Whether rich is installed; a client-only install lacks it."""
    from importlib.util import find_spec

    return find_spec("rich") is not None


def _print_rich(columns: Sequence[Column], rows: Sequence[Sequence[str]]) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console(highlight=False)
    shown = columns_that_fit(columns, rows, console.width - _EDGES)
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, header_style="bold")
    for index in shown:
        # only the first column, a name, may be folded: broken numbers are unreadable
        column = columns[index]
        table.add_column(column.name, justify=column.align, overflow="fold", no_wrap=index > 0)
    for row in rows:
        looks = [columns[index].looks for index in shown]
        texts = [row[index] for index in shown]
        table.add_row(
            *(Text(text, style=look.get(text, "")) for text, look in zip(texts, looks, strict=True))
        )
    console.print(table)
    if missing := [column.name for index, column in enumerate(columns) if index not in shown]:
        hidden = Text(f"hidden (narrow terminal): {', '.join(missing)}", style="bright_black")
        console.print(hidden, soft_wrap=True)


def columns_that_fit(columns: Sequence[Column], rows: Sequence[Sequence[str]], width: int) -> list[int]:
    """Return the indices of the columns to show: all that are not spare, then spare ones that fit."""
    widths = [max(map(len, texts)) for texts in zip([column.name for column in columns], *rows, strict=True)]
    shown: list[int] = []
    for level in sorted({0, *(column.spare for column in columns)}):
        more = [index for index, column in enumerate(columns) if column.spare == level]
        if not level or sum(widths[index] + _GAP for index in shown + more) - _GAP <= width:
            shown += more
    return sorted(shown)


def print_pairs(pairs: Sequence[tuple[str, str]]) -> None:
    """Print ``name  value`` lines with the values aligned; on a terminal, long values are folded."""
    width = max((len(name) for name, _ in pairs), default=0)
    for name, value in pairs:
        print_hanging(f"{name:{width}}  ", value)


def print_hanging(head: str, text: str) -> None:
    """Print ``head`` and ``text`` on one line; on a narrow terminal the text continues indented below."""
    head, lines = printable(head), [printable(text)]
    if sys.stdout.isatty():
        import shutil
        import textwrap

        room = shutil.get_terminal_size().columns - len(head)
        if len(lines[0]) > room >= _NARROWEST:
            lines = textwrap.wrap(lines[0], room, break_long_words=False, break_on_hyphens=False)
    for number, line in enumerate(lines):
        print(f"{' ' * len(head) if number else head}{line}".rstrip())


def user_name(uid: int) -> str:
    """Return the name of a user id; the number if it has no name, ``?`` if the id is unknown."""
    import pwd

    if uid < 0:
        return "?"
    try:
        return pwd.getpwuid(uid).pw_name
    except (KeyError, OverflowError):
        return str(uid)

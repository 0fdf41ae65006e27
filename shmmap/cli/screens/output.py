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
from typing import Final, Literal, NamedTuple, TextIO, TypeAlias

from shmmap.cli.screens.letters import columns_of, folded, padded
from shmmap.quantities import counted, format_bytes, format_duration, format_metres

__all__ = [
    "Column",
    "Line",
    "can_be_written",
    "columns_that_fit",
    "counted",
    "flowing",
    "format_bytes",
    "format_duration",
    "format_metres",
    "json_text",
    "painted",
    "print_hanging",
    "print_json",
    "print_line",
    "print_pairs",
    "print_styled",
    "print_table",
    "printable",
    "rows_text",
    "state_style",
    "user_name",
    "wants_style",
]


_GAP: Final = 2  # blanks between columns

_NARROWEST: Final = 20  # columns that make breaking the text worthwhile

_LONG_NAME: Final = 32  # a longer name in a table's first column is folded before a column is left out


Line: TypeAlias = list[tuple[str, str]]
"""A line of text in pieces, each with its style: words of `_CODES`, or empty."""

_CODES: Final = {
    "bold": 1,
    "red": 31,
    "green": 32,
    "yellow": 33,
    "blue": 34,
    "magenta": 35,
    "cyan": 36,
    "bright_black": 90,
}
"""Numbers of ECMA-48's SGR by word of a style."""


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


def painted(line: Line, *, style: bool) -> str:
    """Return a line's text, unprintable characters escaped; with ``style`` in its colours."""
    if not style:
        return "".join(printable(text) for text, _ in line)
    pieces = []
    for text, words in line:
        codes = ";".join(str(_CODES[word]) for word in words.split())
        pieces.append(f"\x1b[{codes}m{printable(text)}\x1b[0m" if codes and text else printable(text))
    return "".join(pieces)


def state_style(state: str) -> str:
    """Return the style of a state of the daemon, or of a finding."""
    if state in ("ok", "healthy"):
        return "bold green"
    return "bold red" if state in ("fail", "hung", "dead") else "bold yellow"


def print_line(text: str = "", *, file: TextIO | None = None, flush: bool = False) -> None:
    """Print one line."""
    print(printable(text), file=file, flush=flush)


def print_styled(line: Line) -> None:
    """Print a line, in its colours where stdout is a terminal that has them."""
    while line and not line[-1][0].rstrip():
        line = line[:-1]
    print(painted([*line[:-1], *((text.rstrip(), style) for text, style in line[-1:])], style=wants_style()))


def json_text(value: object, *, indent: int | None = None) -> str:
    """Return a JSON document whose strings contain no control codes for terminals, as stdout can write it."""
    import json

    text = json.dumps(value, indent=indent, allow_nan=False, ensure_ascii=False)
    if not can_be_written(text):
        return json.dumps(value, indent=indent, allow_nan=False)
    if text.replace("\n", "").isprintable():
        return text
    # outside strings JSON has no unprintable character but the line break
    return "".join(
        one if one == "\n" or one.isprintable() else json.dumps(one, ensure_ascii=True)[1:-1] for one in text
    )


def can_be_written(text: str) -> bool:
    """Whether the encoding of stdout has all these letters."""
    encoding = sys.stdout.encoding or "utf-8"
    if text.isascii() or encoding.lower() in ("utf-8", "utf8"):
        return True
    try:
        text.encode(encoding)
    except UnicodeEncodeError:
        return False
    return True


def print_json(value: object) -> None:
    """Print a struct or plain values as one JSON document; NaN and infinity are not allowed."""
    if hasattr(value, "__struct_fields__"):
        import msgspec

        value = msgspec.to_builtins(value)
    sys.stdout.write(json_text(value, indent=2 if sys.stdout.isatty() else None) + "\n")


def print_table(columns: Sequence[Column], rows: Sequence[Sequence[str]]) -> None:
    """Print rows under headings, aligned; on a terminal in colours, without the columns that do not fit."""
    rows = [[printable(text) for text in row] for row in rows]
    shown, style, room = list(range(len(columns))), wants_style(), 0
    widths = _widths(columns, rows)
    if sys.stdout.isatty():
        import shutil

        room = shutil.get_terminal_size().columns
        shown = columns_that_fit(columns, rows, room)
        # a name is folded where nothing is left to leave out; broken numbers would be unreadable
        others = sum(widths[index] + _GAP for index in shown[1:])
        widths[shown[0]] = min(widths[shown[0]], max(room - others, _NARROWEST))
    looks = [columns[index].looks if style else {} for index in shown]
    gap = " " * _GAP

    def aligned(texts: Sequence[str]) -> list[str]:
        return [
            padded(text, widths[index], columns[index].align)
            for index, text in zip(shown, texts, strict=True)
        ]

    head = gap.join(aligned([columns[index].name for index in shown])).rstrip()
    lines = [painted([(head, "bold")], style=style)]
    for row in rows:
        name, *rest = (row[index] for index in shown)
        name, *more = folded(name, widths[shown[0]])
        texts = aligned([name, *rest])
        for number, look in enumerate(looks):
            if look:
                texts[number] = painted([(texts[number], look.get(texts[number].strip(), ""))], style=True)
        lines += [gap.join(texts).rstrip(), *more]
    if missing := [column.name for index, column in enumerate(columns) if index not in shown]:
        import textwrap

        hidden = textwrap.wrap(f"hidden (narrow terminal): {', '.join(missing)}", max(room, _NARROWEST))
        lines += [painted([(line, "bright_black")], style=style) for line in hidden]
    print("\n".join(lines))


def wants_style() -> bool:
    """Whether to print colours: stdout is a terminal that supports them, and NO_COLOR is not set."""
    return sys.stdout.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"


def _widths(columns: Sequence[Column], rows: Sequence[Sequence[str]]) -> list[int]:
    """Return how wide each column is."""
    whole = zip([column.name for column in columns], *rows, strict=True)
    return [max(map(columns_of, texts)) for texts in whole]


def columns_that_fit(columns: Sequence[Column], rows: Sequence[Sequence[str]], width: int) -> list[int]:
    """Return the indices of the columns to show: all that are not spare, then spare ones that fit."""
    widths = _widths(columns, rows)
    widths[0] = min(widths[0], _LONG_NAME)
    shown: list[int] = []
    for level in sorted({0, *(column.spare for column in columns)}):
        more = [index for index, column in enumerate(columns) if column.spare == level]
        if not level or sum(widths[index] + _GAP for index in shown + more) - _GAP <= width:
            shown += more
    return sorted(shown)


def flowing(
    units: Sequence[Line], width: int, *, gap: int = 2, first: Line | None = None, later: Line | None = None
) -> list[Line]:
    """Put units side by side, continued on further lines where one is full.

    ``first`` stands before the units of the first line, ``later`` before those of each other line.
    """
    lines: list[Line] = [[*(first or [])]]
    start = used = sum(columns_of(text) for text, _ in lines[0])
    for unit in units:
        length = sum(columns_of(printable(text)) for text, _ in unit)
        if used > start and used + gap + length > width:
            lines.append([*(later or [])])
            used = start
        if used > start:
            lines[-1].append((" " * gap, ""))
            used += gap
        lines[-1] += unit
        used += length
    return lines


def print_pairs(pairs: Sequence[tuple[str, ...]]) -> None:
    """Print ``name  value`` lines with the values aligned; on a terminal, long values are folded.

    Parameters
    ----------
    pairs
        Names and values; a third text is the style of the value.
    """
    width = max((len(pair[0]) for pair in pairs), default=0)
    for name, value, *style in pairs:
        print_hanging(f"{name:{width}}  ", value, *style)


def print_hanging(head: str | Line, text: str, style: str = "") -> None:
    """Print ``head`` and ``text`` on one line; on a narrow terminal the text continues indented below."""
    pieces = [(head, "")] if isinstance(head, str) else head
    indent, lines = len(painted(pieces, style=False)), [printable(text)]
    if sys.stdout.isatty():
        import shutil
        import textwrap

        room = shutil.get_terminal_size().columns - indent
        if len(lines[0]) > room >= _NARROWEST:
            lines = textwrap.wrap(lines[0], room, break_long_words=False, break_on_hyphens=False)
    for number, line in enumerate(lines):
        before = [(" " * indent, "")] if number else pieces
        print(painted([*before, (line, style)], style=wants_style()).rstrip())


def user_name(uid: int) -> str:
    """Return the name of a user id; the number if it has no name, ``?`` if the id is unknown."""
    import pwd

    if uid < 0:
        return "?"
    try:
        return pwd.getpwuid(uid).pw_name
    except (KeyError, OverflowError):
        return str(uid)

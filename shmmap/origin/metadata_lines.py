# SPDX-License-Identifier: Apache-2.0
"""Fast reading of map metadata as writers really write it: one ``name: [x, y]`` per line.

A YAML parser takes minutes for a million entries.  Here a block of lines that all have the divider's
exact form is taken apart with a few array operations, any other block line by line with a pattern
(quotes, comments, floats, spaces, CRLF).  A line that neither understands declines the whole file,
and the real parser reads it: what these accept means the same to it, so nothing is guessed.
"""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from shmmap.origin.metadata_entries import MOST_NAME_BYTES, EntryCollector

__all__ = ["collect_lines"]

# Small enough for the L2 cache, and so that one odd line sends few others to the slower pattern.
_BLOCK_BYTES = 1 << 17
_MAX_NAME_BYTES = 255  # NAME_MAX
_MAX_DIGITS = 9

_NEWLINE, _COLON, _OPEN, _COMMA, _CLOSE, _SPACE, _MINUS, _ZERO = b"\n:[,] -0"

_NAME_BYTE = np.zeros(256, dtype=np.bool_)
_NAME_BYTE[list(b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789_.-+=()/@")] = True
_FIRST_BYTE = _NAME_BYTE.copy()
_FIRST_BYTE[list(b"-=@")] = False

_LINE = re.compile(
    rb"""
    (?: \#[\x20-\x7e\t]*
      | (?: (?P<plain> -?[A-Za-z0-9_./+(][A-Za-z0-9_./+()=@-]* )
          | "(?P<double> [ A-Za-z0-9_./+()=@-]+ )"
          | '(?P<single> [ A-Za-z0-9_./+()=@-]+ )' )
        [ ]* : [ ]+
        (?: \[ [ ]* (?P<x> [-+.0-9a-zA-Z]+ ) [ ]* , [ ]* (?P<y> [-+.0-9a-zA-Z]+ ) [ ]* \]
          | (?P<scalar> [A-Za-z0-9_.+-]+ ) )
        (?: [ ]+ \#[\x20-\x7e\t]* )?
    )?
    [ ]* \r?\n
    """,
    re.VERBOSE,
)


def collect_lines(data: bytes, entries: EntryCollector) -> bool:
    """Read the whole of ``data`` into ``entries``; False if some line needs the real parser."""
    data = data.removeprefix(b"\xef\xbb\xbf")
    for opening in (b"---\n", b"---\r\n"):
        data = data.removeprefix(opening)
    if not data.endswith(b"\n"):
        data += b"\n"
    start = 0
    while start < len(data):
        stop = data.find(b"\n", min(start + _BLOCK_BYTES, len(data) - 1)) + 1
        block = data[start:stop]
        if not (_collect_exact(block, entries) or _collect_pattern(block, entries)):
            return False
        start = stop
    return True


def _collect_exact(block: bytes, entries: EntryCollector) -> bool:
    """Take a block whose every line is ``name: [x, y]`` with plain integers."""
    text = np.frombuffer(block, dtype=np.uint8)
    ends = np.flatnonzero(text == _NEWLINE)
    colons, opens = np.flatnonzero(text == _COLON), np.flatnonzero(text == _OPEN)
    commas, closes = np.flatnonzero(text == _COMMA), np.flatnonzero(text == _CLOSE)
    if not len(ends) == len(colons) == len(opens) == len(commas) == len(closes):
        return False
    starts = np.concatenate(([0], ends[:-1] + 1))
    # comparing whole sequences also proves that each line has one of each
    if not bool(
        (
            (starts < colons)
            & (colons + 2 == opens)
            & (opens + 1 < commas)
            & (commas + 2 < closes)
            & (closes + 1 == ends)
            & (colons - starts <= _MAX_NAME_BYTES)
            & _FIRST_BYTE[text[starts]]
        ).all()
        and (text[colons + 1] == _SPACE).all()
        and (text[commas + 1] == _SPACE).all()
    ):
        return False
    odd_before = np.cumsum(~_NAME_BYTE[text], dtype=np.int32)
    if bool((odd_before[colons - 1] - odd_before[starts] != 0).any()):
        return False
    x, y = _integers(text, opens + 1, commas), _integers(text, commas + 2, closes)
    if x is None or y is None:
        return False
    if int((colons - starts).max(initial=0)) > MOST_NAME_BYTES:
        return False
    return entries.block(_gather_names(text, starts, colons), np.column_stack((x, y)))


def _integers(
    text: NDArray[np.uint8], starts: NDArray[np.intp], stops: NDArray[np.intp]
) -> NDArray[np.float64] | None:
    """Decimal integers at ``text[starts:stops]``; None if any is not, or is written unusually."""
    negative = text[starts] == _MINUS
    starts = starts + negative
    digits = stops - starts
    if bool(((digits < 1) | (digits > _MAX_DIGITS) | ((text[starts] == _ZERO) & (digits > 1))).any()):
        return None
    value = np.zeros(len(starts), dtype=np.int64)
    for place in range(int(digits.max())):
        there = place < digits
        digit = text[np.minimum(starts + place, stops)] - np.uint8(_ZERO)
        if bool((there & (digit > 9)).any()):
            return None
        value = np.where(there, value * 10 + digit, value)
    return np.where(negative, -value, value).astype(np.float64)


def _gather_names(
    text: NDArray[np.uint8], starts: NDArray[np.intp], stops: NDArray[np.intp]
) -> NDArray[np.bytes_]:
    lengths = stops - starts
    width = int(lengths.max())
    column = np.arange(width)
    names = text.take(starts[:, None] + column, mode="clip")
    names[column >= lengths[:, None]] = 0
    return names.view(f"S{width}").reshape(-1)


def _collect_pattern(block: bytes, entries: EntryCollector) -> bool:
    """Take a block line by line."""
    position = 0
    while position < len(block):
        line = _LINE.match(block, position)  # here or nowhere: to search a long line takes time by its square
        if line is None:
            return False
        position = line.end()
        name = line["plain"] or line["double"] or line["single"]
        if name is None:
            continue
        if line["scalar"] is not None:
            taken = entries.scalar(name, line["scalar"].decode())
        else:
            taken = entries.entry(name, line["x"].decode(), line["y"].decode())
        if not taken:
            return False
    return True

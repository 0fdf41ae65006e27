# SPDX-License-Identifier: Apache-2.0
"""Parse lines of numbers into columns: points of ascii PCD, PLY, and plain text clouds.

Integers are parsed as integers, so 64-bit values are exact; float64 is correctly rounded; float32
is the correctly rounded float64, rounded once more.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Callable, Iterator
from decimal import Decimal, InvalidOperation
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.errors import MapDataError
from shmmap.formats.pcd.fields import FieldTable
from shmmap.formats.source_file import SourceFile, refusal

_CHUNK_BYTES: Final = 1 << 18
_LINE_LIMIT_BYTES: Final = 1 << 20
NUMBER: Final = re.compile(
    rb"[+-]?(?:(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?|inf(?:inity)?|nan)\Z", re.IGNORECASE
)


def whole_lines(source: SourceFile, *, bare_cr: bool = False) -> Iterator[tuple[int, bytes]]:
    """Yield (offset, text) of whole lines from the rest of the file; the last may lack its newline.

    ``bare_cr`` replaces each CR by LF.
    """
    carry = b""
    while source.left:
        offset = source.at - len(carry)
        read = source.read(min(source.left, _CHUNK_BYTES)).tobytes()
        text = carry + (read.replace(b"\r", b"\n") if bare_cr else read)
        end = text.rfind(b"\n") + 1 if source.left else len(text)
        carry = text[end:]
        if len(carry) > _LINE_LIMIT_BYTES:
            raise refusal(
                "bad_row",
                f"a line longer than {_LINE_LIMIT_BYTES} bytes",
                path=source.path,
                offset=offset + end,
            )
        if end:
            yield offset, text[:end]


def line_ends(text: bytes) -> NDArray[np.intp]:
    """Return offsets just after each line of ``text``, whose last line may lack its newline."""
    ends = np.flatnonzero(np.frombuffer(text, np.uint8) == 0x0A) + 1
    return ends if text.endswith(b"\n") else np.append(ends, len(text))


class RowParser:
    """Parses whole lines into columns.

    Errors report the row's number, or with ``line_at`` the line at a byte of the file.
    """

    def __init__(self, path: str, table: FieldTable, line_at: Callable[[int], int] | None = None) -> None:
        self.path = path
        self._line_at = line_at
        self.table = table
        self.values = table.values
        self.rows = 0
        self.skipped = 0
        self.surplus = 0
        self.places: dict[str, int] = {}
        place = 0
        for field in table.fields:
            if not field.padding:
                self.places[field.name] = place
            place += field.count

    def blocks(
        self,
        source: SourceFile,
        points: int,
        block_points: int,
        *,
        what: str = "points",
        ahead: int = 0,
        last: bool = True,
        bare_cr: bool = False,
    ) -> Iterator[tuple[NDArray[Any], ...]]:
        """Yield the columns of ``points`` rows of a file, at most ``block_points`` of them at a time.

        Parameters
        ----------
        what
            Name of the points in messages.
        ahead
            Number of rows before them that are left out.
        last
            Whether the file ends with the points; then `count_surplus` counts what follows them.
        bare_cr
            As in `whole_lines`.
        """
        left = points
        for offset, text in whole_lines(source, bare_cr=bare_cr):
            ends = line_ends(text)
            line = at = 0
            while ahead and line < len(ends):
                ahead -= bool(text[at : int(ends[line])].strip())
                at = int(ends[line])
                line += 1
            while line < len(ends) and left:
                line = min(line + min(block_points, left), len(ends))
                stop = int(ends[line - 1])
                block = self.parse(text[at:stop], offset + at)
                left -= len(block[0])
                at = stop
                if len(block[0]):
                    yield block
            if not left:
                if not last:
                    break
                self.count_surplus(text[at:])
        if left:
            raise refusal(
                "truncated",
                f"{points} {what} announced, {points - left} rows are there",
                path=source.path,
                offset=source.size,
            )

    def parse(self, text: bytes, offset: int) -> tuple[NDArray[Any], ...]:
        """Return the columns of the points in ``text``, which starts at byte ``offset`` of the file."""
        tokens = self.tokens(text, offset)
        rows = len(tokens) // self.values
        try:
            # Python's literals may contain underscores, numbers in files may not
            block = self._columns(tokens, rows, fast=b"_" not in text)
        except _BadTokenError as bad:
            raise self._bad_row(text, offset, bad) from None
        self.rows += rows
        return block

    def tokens(self, text: bytes, offset: int) -> list[bytes]:
        """Return all values of the rows in ``text``; other kinds of rows override this."""
        tokens = text.split()
        if b"#" in text or not self._regular(text, len(tokens)):
            return self._tokens_line_by_line(text, offset)
        return tokens

    def count_surplus(self, text: bytes) -> None:
        """Count rows after the last point, ignoring blank and comment lines."""
        for line in text.splitlines():
            words = line.split()
            if words and not words[0].startswith(b"#"):
                self.surplus += 1
            else:
                self.skipped += 1

    def _regular(self, text: bytes, tokens: int) -> bool:
        """Whether every line has exactly the right number of values, checked without a loop."""
        codes = np.frombuffer(text, np.uint8)
        space = (codes == 0x20) | ((codes - np.uint8(9)) < 5)
        starts = ~space
        starts[1:] &= space[:-1]
        ends = line_ends(text) - 1
        if tokens != len(ends) * self.values:
            return False
        firsts = np.flatnonzero(starts)
        if len(firsts) != tokens:
            return False
        lasts = firsts[self.values - 1 :: self.values]
        heads = firsts[:: self.values]
        return bool((lasts <= ends).all() and (heads[1:] > ends[:-1]).all())

    def _tokens_line_by_line(self, text: bytes, offset: int) -> list[bytes]:
        tokens: list[bytes] = []
        at, row = offset, self.rows
        for line in text.split(b"\n"):
            words = line.split()
            if not words or words[0].startswith(b"#"):
                self.skipped += 1
            else:
                row += 1
                if len(words) != self.values:
                    raise self.row_error(row, at, f"{len(words)} values, {self.values} are needed")
                tokens += words
            at += len(line) + 1
        if not text or text.endswith(b"\n"):
            self.skipped -= 1  # text after the last newline is no line
        return tokens

    def _columns(self, tokens: list[bytes], rows: int, *, fast: bool) -> tuple[NDArray[Any], ...]:
        block = self.table.empty_block(rows)
        for axis, field in enumerate(self.table.axes):
            values = _parse(tokens[self.places[field.name] :: self.values], field.dtype, fast=fast)
            self.table.put_axis(block[0], axis, values, self.path)
        for column, field in zip(block[1:], self.table.others, strict=True):
            for part in range(field.count):
                place = self.places[field.name] + part
                values = _parse(tokens[place :: self.values], field.dtype, fast=fast)
                if field.count == 1:
                    column[...] = values
                else:
                    column[:, part] = values
        return block

    def _bad_row(self, text: bytes, offset: int, bad: _BadTokenError) -> MapDataError:
        """Return the error for a bad value, with its line."""
        at, row = offset, 0
        for line in text.split(b"\n"):
            words = line.split()
            if words and not words[0].startswith(b"#"):
                if row == bad.row:
                    break
                row += 1
            at += len(line) + 1
        shown = bad.token[:40].decode("latin-1")
        return self.row_error(
            self.rows + bad.row + 1, at, f"{shown!r} is not a number of type {bad.dtype.str[1:]}"
        )

    def row_error(self, row: int, offset: int, message: str) -> MapDataError:
        """Return the error for a row, counted from 1, that begins at byte ``offset``."""
        place = f"row {row}" if self._line_at is None else f"line {self._line_at(offset)}"
        return refusal("bad_row", f"{place}: {message}", path=self.path, offset=offset)


class _BadTokenError(Exception):
    """A value that does not fit its type; rows counted from 0 within the text being parsed."""

    def __init__(self, row: int, token: bytes, dtype: np.dtype[Any]) -> None:
        super().__init__(token)
        self.row = row
        self.token = token
        self.dtype = dtype


def _parse(words: list[bytes], dtype: np.dtype[Any], *, fast: bool) -> NDArray[Any]:
    """Parse all ``words`` as ``dtype``; ``fast`` allows Python's own parsers."""
    if dtype.kind == "f":
        parsed = _parse_fast(words, float, np.dtype(np.float64)) if fast else None
        if parsed is None:
            parsed = np.array([_number(row, word, dtype) for row, word in enumerate(words)], np.float64)
        with np.errstate(over="ignore", invalid="ignore"):
            return parsed.astype(dtype)
    wide = np.dtype(np.int64 if dtype.kind == "i" else np.uint64)
    parsed = _parse_fast(words, int, wide) if fast else None
    limits = np.iinfo(dtype)
    if parsed is None or (len(parsed) and not (limits.min <= parsed.min() and parsed.max() <= limits.max)):
        parsed = np.array([_integer(row, word, dtype, limits) for row, word in enumerate(words)], wide)
    return parsed.astype(dtype)


def _parse_fast(
    words: list[bytes], convert: Callable[[bytes], Any], dtype: np.dtype[Any]
) -> NDArray[Any] | None:
    """Parse all words with one built-in function; return None if a word is unusual."""
    try:
        if dtype.kind == "u":
            # numpy before 2 accepts -1 for 2**64 - 1; an array refuses it
            return np.asarray(array("Q", map(convert, words)))
        return np.fromiter(map(convert, words), dtype, len(words))
    except (ValueError, OverflowError):
        return None


def _number(row: int, word: bytes, dtype: np.dtype[Any]) -> float:
    if not NUMBER.match(word):
        raise _BadTokenError(row, word, dtype)
    return float(word)


def _integer(row: int, word: bytes, dtype: np.dtype[Any], limits: np.iinfo[Any]) -> int:
    """Parse one integer; ``3.0`` and ``4.2e6`` count as integers, since some writers print them so."""
    if not NUMBER.match(word):
        raise _BadTokenError(row, word, dtype)
    try:
        exact = Decimal(word.decode())
        fits = exact.is_finite() and exact.adjusted() < 20 and exact == exact.to_integral_value()
    except InvalidOperation:
        fits = False
    if not fits or not limits.min <= int(exact) <= limits.max:
        raise _BadTokenError(row, word, dtype)
    return int(exact)

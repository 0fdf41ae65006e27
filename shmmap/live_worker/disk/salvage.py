# SPDX-License-Identifier: Apache-2.0
"""Read the rows of a damaged database from its leaf pages one by one, without its trees.

SQLite's file format (https://www.sqlite.org/fileformat2.html) puts a row into a leaf of its table, and the
end of a long one into a chain of pages.  So a damaged page costs the rows that are on it, wherever it lies
in a tree.  What is found is unchecked, and may be an old version of a row: a page that is free now still
has it.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from typing import Any, Final, TypeAlias

from shmmap.live_worker.disk.schema import PAGE_BYTES, local_bytes

Values: TypeAlias = list[Any]

_TABLE_LEAF: Final = 13
_INDEX: Final = {10: 0, 2: 4}
"""Pages of an index, with the length of what precedes an entry."""
_FIRST_PAGE: Final = 100
"""Length of the file's header, on page 1."""
_MAX_ROW_BYTES: Final = 1 << 28
_INTEGERS: Final = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8}
_LOG_HEADER: Final = struct.Struct(">8I")
_FRAME: Final = struct.Struct(">6I")
_NOT_A_ROW: Final = (IndexError, ValueError, KeyError, struct.error)


class Pages:
    """The pages of a database as of the last commit in its log; a page that cannot be read is empty.

    Parameters
    ----------
    database, log
        Descriptors of the file and of its log; None without a log.
    """

    def __init__(self, database: int, log: int | None) -> None:
        self._database, self._log = database, log
        self._in_log = _committed(log) if log is not None else {}
        self.count = max(os.fstat(database).st_size // PAGE_BYTES, *self._in_log, 0)

    def __getitem__(self, number: int) -> bytes:
        """Return a page; the first has number 1."""
        if not 0 < number <= self.count:
            raise ValueError(number)
        place = self._in_log.get(number)
        if place is not None and self._log is not None:
            return _read(self._log, PAGE_BYTES, place)
        return _read(self._database, PAGE_BYTES, (number - 1) * PAGE_BYTES).ljust(PAGE_BYTES, b"\0")


def _read(fd: int, nbytes: int, place: int) -> bytes:
    try:
        return os.pread(fd, nbytes, place)
    except OSError:
        return b""


def _committed(log: int) -> dict[int, int]:
    """Return where in a log the newest committed version of each page is."""
    found: dict[int, int] = {}
    header = _read(log, _LOG_HEADER.size, 0)
    if len(header) < _LOG_HEADER.size:
        return found
    magic, _, page_bytes, _, *salts, first, second = _LOG_HEADER.unpack(header)
    words = struct.Struct("<2I" if magic & 1 == 0 else ">2I")
    if magic >> 1 != 0x377F0682 >> 1 or page_bytes != PAGE_BYTES:
        return found
    if (sums := _checksum(words, header[:24], (0, 0))) != (first, second):
        return found
    uncommitted: dict[int, int] = {}
    place = _LOG_HEADER.size
    while len(frame := _read(log, _FRAME.size + PAGE_BYTES, place)) == _FRAME.size + PAGE_BYTES:
        number, pages, *rest = _FRAME.unpack_from(frame)
        sums = _checksum(words, frame[_FRAME.size :], _checksum(words, frame[:8], sums))
        if rest != [*salts, *sums]:
            break
        uncommitted[number] = place + _FRAME.size
        place += len(frame)
        if pages:  # a commit
            found.update(uncommitted)
            uncommitted = {}
    return found


def _checksum(words: struct.Struct, data: bytes, sums: tuple[int, int]) -> tuple[int, int]:
    first, second = sums
    for one, other in words.iter_unpack(data):
        first = (first + one + second) & 0xFFFFFFFF
        second = (second + other + first) & 0xFFFFFFFF
    return first, second


def table_rows(pages: Pages) -> Iterator[tuple[int, Values]]:
    """Yield the number and the values of every row on a table's leaf, whatever the table."""
    for page, place in _cells(pages, {_TABLE_LEAF: 0}):
        try:
            nbytes, place = _varint(page, place)
            number, place = _varint(page, place)
            yield number, _values(_payload(pages, page, place, nbytes))
        except _NOT_A_ROW:  # noqa: PERF203  the next one may be good
            continue


def index_entries(pages: Pages) -> Iterator[Values]:
    """Yield the values of every short entry on a page of an index, whatever the index."""
    for page, place in _cells(pages, _INDEX):
        try:
            nbytes, place = _varint(page, place)
            yield _values(page[place : place + nbytes])
        except _NOT_A_ROW:  # noqa: PERF203  the next one may be good
            continue


def _cells(pages: Pages, kinds: dict[int, int]) -> Iterator[tuple[bytes, int]]:
    """Yield pages of these kinds with the place of each cell on them, after what precedes it."""
    for number in range(1, pages.count + 1):
        page = pages[number]
        start = _FIRST_PAGE if number == 1 else 0
        skipped = kinds.get(page[start])
        if skipped is None:
            continue
        array = start + 8 + skipped
        count = int.from_bytes(page[start + 3 : start + 5], "big")
        for at in range(array, min(array + 2 * count, PAGE_BYTES - 1), 2):
            yield page, int.from_bytes(page[at : at + 2], "big") + skipped


def _varint(data: bytes, place: int) -> tuple[int, int]:
    value = 0
    for _ in range(8):
        byte = data[place]
        place += 1
        value = value << 7 | byte & 127
        if byte < 128:
            return value, place
    return value << 8 | data[place], place + 1


def _payload(pages: Pages, page: bytes, place: int, nbytes: int) -> bytes:
    if nbytes > _MAX_ROW_BYTES:
        raise ValueError(nbytes)
    local = local_bytes(nbytes)
    parts = [page[place : place + local]]
    left, following = nbytes - local, page[place + local : place + local + 4]
    while left > 0:  # each step takes a page's bytes off: a circle of pages ends as well
        page = pages[int.from_bytes(following, "big")]
        following, part = page[:4], page[4 : 4 + left]
        parts.append(part)
        left -= len(part)
    return b"".join(parts)


def _values(payload: bytes) -> Values:
    """Return the values of a record; raise what `_NOT_A_ROW` names."""
    length, place = _varint(payload, 0)
    kinds = []
    while place < length:
        kind, place = _varint(payload, place)
        kinds.append(kind)
    found: Values = []
    for kind in kinds:
        nbytes = (kind - 12) // 2 if kind >= 12 else _INTEGERS.get(kind, 0)
        value = payload[place : place + nbytes]
        place += nbytes
        if len(value) < nbytes:
            raise ValueError(kind)
        if kind >= 12:
            found.append(value.decode() if kind & 1 else value)
        elif nbytes:
            found.append(int.from_bytes(value, "big", signed=True))
        else:
            found.append({0: None, 8: 0, 9: 1}[kind])
    return found

# SPDX-License-Identifier: Apache-2.0
"""Read the rows of a damaged database from its leaf pages one by one, without its trees.

SQLite's file format (https://www.sqlite.org/fileformat2.html) puts a row into a leaf of its table, and the
end of a long one into a chain of pages.  So a damaged page costs the rows that are on it, wherever it lies
in a tree.  What is found is unchecked, and may be an old version of a row: a page that is free now still
has it.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from shmmap.live_worker.disk.schema import PAGE_BYTES, local_bytes

Values: TypeAlias = list[Any]

_TABLE_LEAF: Final = 13
_INDEX: Final = {10: 0, 2: 4}
"""Pages of an index, with the length of what precedes an entry."""
_FIRST_PAGE: Final = 100
"""Length of the file's header, on page 1."""
_MAGIC: Final = b"SQLite format 3\0"
_MAX_ROW_BYTES: Final = 1 << 28
_INTEGERS: Final = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8}
_LOG_HEADER: Final = 32
_LOG_MAGIC: Final = 0x377F0683
"""First number of a log, apart from the order of bytes in checksums."""
_FRAME_HEADER: Final = 24
_FRAME: Final = _FRAME_HEADER + PAGE_BYTES
_FRAMES_PER_READ: Final = 1024
_NOT_A_ROW: Final = (IndexError, ValueError, KeyError)


class Log:
    """The log of a database: each of its frames is a page as a transaction left it.

    A frame's checksum continues that of the one before.  SQLite reads up to the first frame that is not
    right, and drops whatever was committed after it.

    Parameters
    ----------
    nbytes
        Its length.
    read
        Returns this many of its bytes, from a place on; fewer at its end.

    Attributes
    ----------
    count
        Number of frames.
    read
        Number of frames that SQLite reads.
    """

    def __init__(self, nbytes: int, read: Callable[[int, int], bytes]) -> None:
        self._read = read
        header = np.frombuffer(self._at(0, _LOG_HEADER), np.uint32)[np.newaxis]
        first = header.view(">u4")
        is_right = (_checksums(header[:, :6], np.zeros_like(header)) == first[:, 6:]).all()
        has_header = bool(is_right and first[0, 0] | 1 == _LOG_MAGIC)
        self.count = max(0, nbytes - _LOG_HEADER) // _FRAME
        if self.count == 1 and not has_header:
            self.count = 0  # both are on one page
        fields = np.empty((self.count, _FRAME_HEADER // 4), ">u4")
        is_right = np.empty(self.count, bool)
        before = first[:, 6:]
        for begin in range(0, self.count, _FRAMES_PER_READ):
            part = slice(begin, min(begin + _FRAMES_PER_READ, self.count))
            data = self._at(_LOG_HEADER + begin * _FRAME, (part.stop - begin) * _FRAME)
            frames = np.frombuffer(data, np.uint32).reshape(-1, _FRAME // 4)
            fields[part] = frames[:, : _FRAME_HEADER // 4].view(">u4")
            sums = np.concatenate([before, fields[part, 4:6]])
            found = _checksums(np.delete(frames, slice(2, 6), axis=1), sums[:-1])
            is_right[part] = (found == sums[1:]).all(axis=1)
            before = sums[-1:]
        self._numbers, pages, salts = fields[:, 0], fields[:, 1], fields[:, 2:4]
        is_current = (salts == (first[:, 4:6] if has_header else salts[1:2])).all(axis=1)
        is_good = is_right & is_current
        follows_good = np.concatenate([[has_header], is_good])[: self.count]
        # whether a frame after a damaged one is right cannot be seen
        self._is_usable = (self._numbers > 0) & is_current & (is_good | ~follows_good)
        self._good = int(np.argmin([*(is_good & has_header), False]))
        commits = np.flatnonzero(is_good & (pages > 0)) + 1
        self.read = int(commits[commits <= self._good].max(initial=0))
        self._committed = int(commits.max(initial=0))

    def is_damaged(self, *, was_cut: bool) -> bool:
        """Return whether a frame is not as it was written.

        Parameters
        ----------
        was_cut
            Whether the power may have been cut since: then pages are missing that had not been flushed.
        """
        if not was_cut:
            return self._good < self.count
        return self.read < self._committed and not self._is_unwritten

    @property
    def _is_unwritten(self) -> bool:
        """Whether the first frame that is not right is on a page that the disk never got: it is zeros."""
        begin = _LOG_HEADER + self._good * _FRAME
        pages = range(begin - begin % PAGE_BYTES, begin + _FRAME, PAGE_BYTES)
        parts = ((max(begin, page), page + PAGE_BYTES) for page in pages)
        return any(not any(self._read(end - start, start)) for start, end in parts)

    def newest(self, frames: int) -> dict[int, int]:
        """Return where in these first frames the newest version of each page is."""
        usable = np.flatnonzero(self._is_usable[:frames])
        return dict(zip(self._numbers[usable].tolist(), usable.tolist(), strict=True))

    def page(self, frame: int) -> bytes:
        """Return the page in a frame."""
        return self._at(_LOG_HEADER + frame * _FRAME + _FRAME_HEADER, PAGE_BYTES)

    def _at(self, start: int, nbytes: int) -> bytes:
        return self._read(nbytes, start).ljust(nbytes, b"\0")


def _checksums(words: NDArray[np.uint32], before: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Return the checksum of each row of words, which continues the two numbers in its row of ``before``."""
    first, second = before[:, 0].astype(np.uint32), before[:, 1].astype(np.uint32)
    for at in range(0, words.shape[1], 2):
        first = first + words[:, at] + second
        second = second + words[:, at + 1] + first
    return np.stack([first, second], axis=1)


NO_LOG: Final = Log(0, lambda _nbytes, _start: b"")
"""That of a database without one."""


class Pages:
    """The pages of a database, and of the first frames of its log; a page that cannot be read is empty.

    Parameters
    ----------
    database
        Descriptor of the file; None for the pages that are in the log.
    """

    def __init__(self, database: int | None, log: Log, frames: int) -> None:
        self._database, self._log = database, log
        self._in_log = log.newest(frames)
        self.numbers: Iterable[int] = self._in_log
        self._count, self._in_file = max(self._in_log, default=0), 0
        if database is not None:
            self._in_file = os.fstat(database).st_size // PAGE_BYTES
            self._count = self._in_file + log.count
            self.numbers = range(1, self._count + 1)

    def __getitem__(self, number: int) -> bytes:
        """Return a page; the first has number 1."""
        if not 0 < number <= self._count:
            raise ValueError(number)
        frame = self._in_log.get(number)
        if frame is not None:
            return self._log.page(frame)
        found = b""
        if self._database is not None:
            with contextlib.suppress(OSError):
                found = os.pread(self._database, PAGE_BYTES, (number - 1) * PAGE_BYTES)
        return found.ljust(PAGE_BYTES, b"\0")

    @property
    def is_cut(self) -> bool:
        """Whether there is no header, or some page is missing of those that it counts."""
        header = self[1] if self._count else b""
        missing = range(self._in_file + 1, int.from_bytes(header[28:32], "big") + 1)
        return not header.startswith(_MAGIC) or any(number not in self._in_log for number in missing)


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
    for number in pages.numbers:
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

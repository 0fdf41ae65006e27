# SPDX-License-Identifier: Apache-2.0
"""The PCD files of a map being divided: rows are appended, headers are written last.

A file begins with room for its header, so that each row is written once, at its final place.  Places are
assigned in the order of the blocks, and filled in any order.  So rows keep their order within a cell although
blocks are processed in parallel.

A run that may be resumed keeps a journal: place, length and hash (XXH3) of every piece written.  What the
journal does not confirm is not taken.
"""

from __future__ import annotations

import os
import resource
import threading
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from xxhash import xxh3_64_intdigest

from shmmap.dividing.lattice import CellLattice
from shmmap.errors import BadRequest
from shmmap.formats.pcd.writer import pcd_header
from shmmap.origin.metadata import METADATA_NAME, metadata_text
from shmmap.private_directory import open_own

_ALIGNMENT: Final = 64
_SPARE_DESCRIPTORS: Final = 128
_MAX_POINTS: Final = (1 << 32) - 1

_PIECE: Final = np.dtype([("ix", "<i8"), ("iy", "<i8"), ("at", "<i8"), ("bytes", "<i8"), ("hash", "<u8")])

Slot = tuple[int, str, int]  # (descriptor or -1, path, offset): place of a cell's next rows


class CellFiles:
    """Files of cells by cell index (ix, iy).

    Parameters
    ----------
    directory
        Directory of the files.
    row
        Packed type of a point.
    name
        Function that returns the file name of a cell.
    journal
        Path of the journal; empty: none is kept.

    Attributes
    ----------
    counts
        Rows of each cell, including those being written.
    """

    def __init__(
        self,
        directory: str,
        row: np.dtype[np.void],
        name: Callable[[int, int], str],
        *,
        journal: str = "",
    ) -> None:
        self.directory = directory
        self.row = row
        self.counts: dict[tuple[int, int], int] = {}
        self.name = name
        self._fields = pcd_fields(row)
        longest = len(pcd_header(self._fields, _MAX_POINTS, "binary"))
        self.header_bytes = -(-longest // _ALIGNMENT) * _ALIGNMENT
        self._descriptors: dict[tuple[int, int], int] = {}
        soft, _hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        self._max_open = max(16, soft - _SPARE_DESCRIPTORS)
        self._journal = open_own(journal, os.O_RDWR | os.O_CREAT) if journal else -1
        self._journal_lock = threading.Lock()

    def path(self, where: tuple[int, int]) -> str:
        """Return the path of a cell's file."""
        return os.path.join(self.directory, self.name(*where))

    def reserve(self, where: tuple[int, int], rows: int) -> Slot:
        """Reserve places for ``rows`` further rows of a cell.

        Raises
        ------
        BadRequest
            The cell would exceed the maximum number of points of a PCD file.
        """
        have = self.counts.get(where, 0)
        if have + rows > _MAX_POINTS:
            raise BadRequest(
                f"the cell {self.name(*where)} has more points than a PCD file can", hint="smaller cells"
            )
        path = self.path(where)
        fd = self._descriptors.get(where, -1)
        if fd < 0 and len(self._descriptors) < self._max_open:
            fd = self._descriptors[where] = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o666)
        self.counts[where] = have + rows
        return fd, path, self.header_bytes + have * self.row.itemsize

    def finish(self) -> None:
        """Write every header; no rows may still be in writing."""
        for where, count in self.counts.items():
            header = pcd_header(self._fields, count, "binary", header_bytes=self.header_bytes)
            write_at((self._descriptors.get(where, -1), self.path(where), 0), header)
        self.close()

    def written(self, pieces: Sequence[tuple[int, int, int, int, int]]) -> None:
        """Note pieces in the journal: (ix, iy, offset, bytes, hash of the bytes) each."""
        with self._journal_lock:
            write_at((self._journal, "", self.noted_bytes()), np.array(pieces, _PIECE).tobytes())

    @property
    def has_journal(self) -> bool:
        """Whether pieces are noted in a journal."""
        return self._journal >= 0

    def noted_bytes(self) -> int:
        """Return the length of the journal."""
        return os.fstat(self._journal).st_size if self.has_journal else 0

    def forget(self) -> None:
        """Forget all cells and what was noted of them."""
        self.counts.clear()
        if self.has_journal:
            os.ftruncate(self._journal, 0)

    def restore(self, counts: Iterable[tuple[int, int, int]], noted_bytes: int) -> None:
        """Return to an earlier state, (ix, iy, rows) of every cell; later rows are removed.

        Parameters
        ----------
        noted_bytes
            Length of the journal in that state.

        Raises
        ------
        OSError
            A file is missing, or its bytes are not those that were written.
        """
        self.counts = {(ix, iy): rows for ix, iy, rows in counts}
        known = {self.name(*where) for where in self.counts}
        for name in os.listdir(self.directory):
            if name not in known:
                os.unlink(os.path.join(self.directory, name))
        if self.noted_bytes() < noted_bytes or noted_bytes % _PIECE.itemsize:
            raise OSError("the journal is too short")
        os.ftruncate(self._journal, noted_bytes)
        with open(self._journal, "rb", closefd=False) as file:
            pieces = np.fromfile(file, _PIECE)
        pieces = pieces[np.lexsort((pieces["at"], pieces["iy"], pieces["ix"]))]
        cells, starts = np.unique(pieces[["ix", "iy"]], return_index=True)
        if {(int(ix), int(iy)) for ix, iy in cells} != set(self.counts):
            raise OSError("the journal is of other cells")
        for cell, of_cell in zip(cells, np.split(pieces, starts[1:]), strict=True):
            self._verify((int(cell["ix"]), int(cell["iy"])), of_cell)

    def _verify(self, where: tuple[int, int], pieces: NDArray[Any]) -> None:
        """Compare a cell's file with its pieces, in order of their places, and cut off what comes after."""
        path = self.path(where)
        fd = open_own(path, os.O_RDWR)
        try:
            end = self.header_bytes
            for _, _, at, nbytes, digest in pieces.tolist():
                if at != end or xxh3_64_intdigest(os.pread(fd, nbytes, at)) != digest:
                    raise OSError(f"{path} is not what was written")
                end += nbytes
            if end != self.header_bytes + self.counts[where] * self.row.itemsize:
                raise OSError(f"{path} has other rows than were written")
            os.ftruncate(fd, end)
        finally:
            os.close(fd)

    def read(self, where: tuple[int, int]) -> NDArray[np.void]:
        """Return all rows of a cell."""
        path, count = self.path(where), self.counts[where]
        rows: NDArray[np.void] = np.fromfile(path, self.row, count, offset=self.header_bytes)
        if len(rows) < count:
            raise OSError(f"{path} became shorter")
        return rows

    def close(self) -> None:
        """Close every file."""
        while self._descriptors:
            os.close(self._descriptors.popitem()[1])
        if self.has_journal:
            os.close(self._journal)
            self._journal = -1


def write_at(slot: Slot, data: Any) -> None:
    """Write ``data`` at the place ``slot``."""
    fd, path, offset = slot
    own = fd < 0
    if own:
        fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o666)
    try:
        view = memoryview(data).cast("B")
        while len(view):
            done = os.pwrite(fd, view, offset)
            view, offset = view[done:], offset + done
    finally:
        if own:
            os.close(fd)


def raise_open_files_limit() -> None:
    """Raise the limit of open files as far as allowed: maps have more cells than the usual limit of 1024."""
    _soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


def pcd_fields(row: np.dtype[np.void]) -> list[tuple[str, np.dtype[Any], int]]:
    """Return name, dtype and count of each field of a row, in the form of a PCD header."""
    return [(name, row[name].base, int(np.prod(row[name].shape, dtype=int))) for name in row.names or ()]


def write_metadata(
    directory: str, lattice: CellLattice, prefix: str, wheres: Iterable[tuple[int, int]]
) -> None:
    """Write the metadata of a divided map's cells, as Autoware's loader reads them."""
    entries = ((lattice.file_name(prefix, *where), lattice.corner_text(*where)) for where in wheres)
    Path(directory, METADATA_NAME).write_text(metadata_text(lattice.size_text, entries), encoding="utf-8")

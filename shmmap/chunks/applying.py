# SPDX-License-Identifier: Apache-2.0
"""Apply marks to a chunk atomically and exactly once per scan, even if the writer dies.

Before a change, the writer copies the affected part of the chunk into an *undo record*, in separate shared
memory that outlives it.  If the writer dies before it discards the record, the next writer restores the copy,
and the mapper, which has no answer yet, sends the scan again.  A chunk remembers the last scan of each
mapper, so a scan that is sent twice changes it once.

Readers detect a change in progress by the chunk's sequence, which is odd meanwhile (`ChunkView.state`).
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from shmmap.chunks import applying_kernels as kernels
from shmmap.chunks.layout import (
    HEADER_BYTES,
    MAPPERS,
    MAX_BYTES,
    STATE_AT,
    ChunkView,
)
from shmmap.chunks.occupancy import Occupancy
from shmmap.chunks.voxels import BRICK_VOXELS, BRICKS, ChunkKey
from shmmap.errors import SegmentCorrupt
from shmmap.failpoints import step

if TYPE_CHECKING:
    from collections.abc import Callable, Container

    from numpy.typing import NDArray

_MAGIC: Final = b"SHMUNDO\0"
_UNDO: Final = struct.Struct("<8sQQ3iI")
_IN_FORCE_AT: Final = 8
_BODY_AT: Final = 64
UNDO_BYTES: Final = _BODY_AT + 2 * BRICKS + MAX_BYTES


class UndoRecord:
    """Copy of the part of a chunk that the writer is changing; at most one record is valid at a time.

    Parameters
    ----------
    data
        `UNDO_BYTES` of memory that outlives the writer.
    """

    def __init__(self, data: Any) -> None:
        self._data = memoryview(data).cast("B")
        self._in_force: NDArray[np.uint64] = np.ndarray((1,), "<u8", self._data, _IN_FORCE_AT)
        self._numbers: NDArray[np.uint16] = np.ndarray((BRICKS,), "<u2", self._data, _BODY_AT)
        self._header: NDArray[np.uint8] = np.ndarray(
            (HEADER_BYTES,), np.uint8, self._data, _BODY_AT + 2 * BRICKS
        )
        self._bricks: NDArray[np.int16] = np.ndarray(
            (BRICKS, BRICK_VOXELS), "<i2", self._data, _BODY_AT + 2 * BRICKS + HEADER_BYTES
        )

    @property
    def of(self) -> tuple[ChunkKey, int] | None:
        """Key and generation of the chunk that was being changed; None if none was."""
        magic, in_force, generation, x, y, z, _ = _UNDO.unpack_from(self._data)
        return (ChunkKey(x, y, z), generation) if magic == _MAGIC and in_force & 1 else None

    def keep(self, view: ChunkView, touched: NDArray[np.uint16]) -> None:
        """Copy a chunk's header and the bricks at these places, and mark the record as valid."""
        identity = view.identity
        count = len(touched)
        _UNDO.pack_into(self._data, 0, _MAGIC, 0, identity.generation, *identity.key, count)
        self._numbers[:count] = touched
        self._header[:] = view.data[:HEADER_BYTES]
        # no index is ever clipped: in any other mode numpy copies twice
        np.take(view.bricks, touched - 1, axis=0, out=self._bricks[:count], mode="clip")
        step("live.copied")
        kernels.begin_writing(self._in_force)

    def drop(self) -> None:
        """Discard the undo record: the change is complete."""
        kernels.end_writing(self._in_force)

    def restore(self, view: ChunkView) -> None:
        """Restore the copy into the chunk that `of` names.

        Raises
        ------
        SegmentCorrupt
            The record names bricks that the chunk does not have.
        """
        count = _UNDO.unpack_from(self._data)[-1]
        sequence = view.state["sequence"].reshape(1)
        kernels.begin_writing(sequence)
        old = ChunkView(self._header)
        bricks = int(old.state["bricks"])
        numbers = self._numbers[: min(count, BRICKS)]
        if count > BRICKS or bricks > len(view.bricks) or (numbers == 0).any() or (numbers > bricks).any():
            raise SegmentCorrupt("undo record: it is not one of this chunk")
        view.bricks[numbers.astype(np.intp) - 1] = self._bricks[: len(numbers)]
        view.bricks[bricks:] = 0
        view.data[STATE_AT + 8 : HEADER_BYTES] = self._header[STATE_AT + 8 :].tobytes()
        kernels.end_writing(sequence)
        self.drop()


class ChunkWriter:
    """Changes chunks; for one process and thread at a time.

    Parameters
    ----------
    occupancy
        Parameters of the log-odds update.
    undo
        Undo record, valid while a chunk is changed.
    """

    def __init__(self, occupancy: Occupancy, undo: UndoRecord) -> None:
        self._limits = np.array([*occupancy.steps, *occupancy.thresholds], np.int64)
        self._undo = undo
        self._touched = np.zeros(BRICKS, np.uint16)

    def new_bricks(self, view: ChunkView, words: NDArray[np.uint16]) -> int:
        """Return the number of new bricks that these words add to a chunk."""
        count: int = kernels.touched_bricks(view.index, words, self._touched)
        return count

    def apply(
        self,
        view: ChunkView,
        words: NDArray[np.uint16],
        bits: NDArray[np.uint64],
        hits: int,
        *,
        mapper: int,
        scan: int,
        now_ns: int,
        grow: Callable[[int], ChunkView],
        known_mappers: Container[int] = (),
    ) -> ChunkView:
        """Add one scan's evidence to a chunk, unless it was added before.

        Parameters
        ----------
        words, bits, hits
            The chunk's part of `Marks`, already checked.
        mapper, scan
            The scan's mapper, and the scan's number, which increases for each mapper.
        now_ns
            Time of the change, nanoseconds since 1970.
        grow
            Given a number of bricks, returns a view of the same chunk with room for that many; called before
            any change.
        known_mappers
            Numbers of the map's mappers; the last scans of others may be forgotten.

        Returns
        -------
        ChunkView
            The chunk, grown if necessary.
        """
        row = self._row(view, mapper)
        if row is not None and int(view.state["mappers"]["scan"][row]) >= scan:
            return view
        bricks = int(view.state["bricks"]) + self.new_bricks(view, words)
        if bricks > len(view.bricks):
            view = grow(bricks)
        self._undo.keep(view, self._touched[: np.count_nonzero(self._touched)])
        state = view.state
        sequence = state["sequence"].reshape(1)
        counts = np.array([state[name] for name in _COUNTED], np.int64)
        kernels.begin_writing(sequence)
        step("live.odd")
        kernels.add_evidence(view.index, view.bricks.reshape(-1), words, bits, hits, self._limits, counts)
        step("live.applied")
        for name, count in zip(_COUNTED, counts.tolist(), strict=True):
            state[name] = count
        state["version"] += 1
        state["changed_ns"] = now_ns
        if row is None:
            row = self._row_for(view, known_mappers)
            state["mappers"]["number"][row] = mapper
        state["mappers"]["scan"][row] = scan
        kernels.end_writing(sequence)
        step("live.even")
        self._undo.drop()
        return view

    @staticmethod
    def _row(view: ChunkView, mapper: int) -> int | None:
        """Return the row of a mapper's last scan; None if the chunk has none."""
        found = np.flatnonzero(view.state["mappers"]["number"] == mapper)
        return int(found[0]) if len(found) else None

    @staticmethod
    def _row_for(view: ChunkView, known: Container[int]) -> int:
        """Return a free row, or that of a mapper that the map does not know any more."""
        numbers = view.state["mappers"]["number"].tolist()
        for row, number in enumerate(numbers):
            if number == 0 or number not in known:
                return row
        raise SegmentCorrupt(f"a chunk remembers {MAPPERS} mappers, and all of them are the map's")


_COUNTED: Final = ("bricks", "active", "occupied", "free")

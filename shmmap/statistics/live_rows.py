# SPDX-License-Identifier: Apache-2.0
"""Rows about live maps in the statistics segment: what is in memory, what is not saved yet, what is wrong."""

from __future__ import annotations

import struct
import zlib
from typing import Final, NamedTuple

from shmmap.errors import SegmentCorrupt

__all__ = ["LIVE_ROW_BYTES", "MAX_LIVE", "LiveRow", "pack_live", "unpack_live"]

LIVE_ROW: Final = struct.Struct("<64s256s17q52x")
LIVE_ROW_BYTES: Final = LIVE_ROW.size + 4
MAX_LIVE: Final = 64  # more live maps than that are not shown

PROBLEM_BYTES: Final = 256


class LiveRow(NamedTuple):
    """One live map.

    Attributes
    ----------
    name
        What clients call it.
    problem
        What keeps chunks from being saved or loaded just now (cut after 256 bytes); empty: nothing.
    chunks, active, bytes
        Chunks in memory, known voxels in them, and their memory.
    loading, dirty, saving
        Chunks that are being read, that are changed and not saved, that are being written.
    evicting, evicting_bytes
        0: memory of a chunk that is given up is free at once.
    waiting_bytes
        Scans that wait for chunks or for memory.
    files, file_bytes
        Chunks on disk.
    scans, durable
        Scans applied since the process that keeps live maps began, and of these how many are on the disk.
    budget_bytes
        Most memory of its chunks.
    damaged
        Files that were put aside, and chunks that are missing.
    mappers
        Programs that have mapped.
    change
        Number of its last change.
    """

    name: str
    problem: str
    chunks: int
    active: int
    bytes: int
    loading: int
    dirty: int
    saving: int
    evicting: int
    evicting_bytes: int
    waiting_bytes: int
    files: int
    file_bytes: int
    scans: int
    durable: int
    budget_bytes: int
    damaged: int
    mappers: int
    change: int

    @property
    def unsaved(self) -> int:
        """Chunks that are newer in memory than on the disk."""
        return self.dirty + self.saving

    @property
    def failing(self) -> bool:
        """Whether chunks cannot be loaded or saved just now."""
        return bool(self.problem)

    @property
    def states(self) -> dict[str, int]:
        """How many chunks are in which state."""
        return {
            "loading": self.loading, "clean": max(0, self.chunks - self.unsaved), "dirty": self.dirty,
            "saving": self.saving,
        }  # fmt: skip


def pack_live(row: LiveRow) -> bytes:
    """Return the 512 bytes of one row."""
    problem = row.problem.encode("utf-8", "replace")[:PROBLEM_BYTES].decode("utf-8", "ignore").encode()
    body = LIVE_ROW.pack(row.name.encode(), problem, *row[2:])
    return body + struct.pack("<I", zlib.crc32(body))


def unpack_live(data: bytes | memoryview) -> LiveRow | None:
    """Return one row; None if there was none yet.

    Raises
    ------
    SegmentCorrupt
        If it is torn: the writer was changing it.
    """
    end = LIVE_ROW.size
    if zlib.crc32(data[:end]) != int.from_bytes(data[end : end + 4], "little"):
        if not any(data):
            return None
        raise SegmentCorrupt("a live map's row of the statistics is torn")
    name, problem, *numbers = LIVE_ROW.unpack_from(data)
    return LiveRow(
        name.rstrip(b"\0").decode("utf-8", "replace"), problem.rstrip(b"\0").decode("utf-8", "replace"),
        *numbers,
    )  # fmt: skip

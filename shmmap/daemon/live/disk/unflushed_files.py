# SPDX-License-Identifier: Apache-2.0
"""Chunk files that are written but not flushed yet; many are flushed together.

A file is written under an interim name.  `UnflushedFiles.flush` flushes its content, gives it its final name,
and flushes the name, too.  Until then its bytes are kept in memory: if the kernel discards data that it could
not write, the file is written again.

A replaced file is not deleted but kept as a spare, to be overwritten by the next file.  Creating a file is
slow: ext4 examines every file deleted in the last seconds.  A spare is overwritten only when its former name
is durable as another file's, so that no crash can make it needed again.
"""

from __future__ import annotations

import contextlib
import threading
from dataclasses import dataclass
from typing import Final

from shmmap.chunks.voxels import ChunkKey
from shmmap.daemon.live.disk.folder import Folder, write_beside
from shmmap.daemon.live.disk.map_record import CHUNK
from shmmap.failpoints import step

__all__ = ["UnflushedFiles"]

_ENTRY_BYTES: Final = 1 << 10
"""Memory of an unflushed file in addition to its content."""


@dataclass(eq=False, slots=True)
class _Written:
    interim: str
    data: bytes
    is_flushed: bool = False  # just now
    failed: bool = False

    @property
    def nbytes(self) -> int:
        return len(self.data) + _ENTRY_BYTES


class UnflushedFiles:
    """Unflushed files of one map.  Usable from any thread, but by one thread at a time for each chunk.

    Attributes
    ----------
    nbytes : int
        Memory of the files in this process.
    flushing : threading.Lock
        Held while files get their final names.
    """

    def __init__(self, files: Folder) -> None:
        self._files = files
        self.nbytes = 0
        self._written: dict[ChunkKey, _Written] = {}
        self._spare: list[str] = []
        self._changing, self.flushing = threading.Lock(), threading.Lock()

    def get(self, key: ChunkKey) -> bytes | None:
        """Return the newest content of a chunk's file; None if the newest file has its final name."""
        written = self._written.get(key)
        return written.data if written is not None else None

    def write(self, key: ChunkKey, data: bytes) -> None:
        """Write the file of a chunk; after an OSError nothing has changed."""
        written = _Written(self._write(data), data)
        step("live.written")
        with self._changing:
            before = self._written.get(key)
            self._written[key] = written
            self.nbytes += written.nbytes - (before.nbytes if before is not None else 0)
            obsolete = before if before is not None and not before.is_flushed else None
            if obsolete is not None and not obsolete.failed:
                self._spare.append(obsolete.interim)
        if obsolete is not None and obsolete.failed:
            self._remove(obsolete.interim)  # or an older file, whose final name may be durable

    def _write(self, data: bytes) -> str:
        """Write a file, over a spare one if there is any; return its name."""
        with self._changing:
            spare = self._spare.pop() if self._spare else ""
        try:
            if not spare:
                return self._make(data)
            self._files.overwrite(spare, data)
        except OSError:
            if spare:
                self._remove(spare)
            self.remove_spare()  # the disk may be full
            raise
        return spare

    def _make(self, data: bytes) -> str:
        return write_beside(self._files, CHUNK.removeprefix("."), data)

    def _remove(self, name: str) -> None:
        with contextlib.suppress(OSError):  # the next start removes it
            self._files.remove(name)

    def remove_spare(self, kept: int = 0) -> None:
        """Remove spare files, except for this many."""
        with self._changing:
            self._spare, surplus = self._spare[:kept], self._spare[kept:]
        for name in surplus:
            self._remove(name)

    def flush(self) -> dict[ChunkKey, bytes]:
        """Make the written files durable and return them; files written meanwhile are left to the next flush.

        Raises
        ------
        OSError
            Some files are not on disk; the next flush writes all of them again.
        """
        with self.flushing:  # a second caller waits until the files are durable
            with self._changing:
                taken = dict(self._written)
                for one in taken.values():
                    one.is_flushed = True
            if not taken:
                return {}
            try:
                for one in taken.values():
                    self._sync(one)
                step("live.synced")
                replaced = []
                for key, one in taken.items():
                    if self._give_name(one.interim, key.text + CHUNK):
                        replaced.append(one.interim)
                    step("live.renamed")
                self._files.sync_names()
                step("live.flushed")
            except OSError:
                self._note_failure(taken)
                raise
            with self._changing:
                for key, one in taken.items():
                    if self._written.get(key) is one:
                        del self._written[key]
                        self.nbytes -= one.nbytes
                self._spare += replaced
            self.remove_spare(len(taken))
            return {key: one.data for key, one in taken.items()}

    def _sync(self, one: _Written) -> None:
        if one.failed:
            old, one.interim = one.interim, self._make(one.data)
            self._remove(old)  # or an older file that had its name, or nothing
        self._files.sync(one.interim)

    def _give_name(self, interim: str, name: str) -> bool:
        """Give a file its final name; return whether the previous file has the interim name now."""
        try:
            self._files.exchange(interim, name)
        except OSError:  # there is none, or the file system cannot
            self._files.rename(interim, name)
            return False
        return True

    def _note_failure(self, taken: dict[ChunkKey, _Written]) -> None:
        """Record a failed flush: all its files are written again, except those replaced meanwhile."""
        with self._changing:
            for key, one in taken.items():
                one.is_flushed, one.failed = False, True
                if self._written.get(key) is not one:
                    self._remove(one.interim)

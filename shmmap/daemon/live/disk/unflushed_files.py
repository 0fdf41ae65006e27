# SPDX-License-Identifier: Apache-2.0
"""Files of chunks between being written and being on the disk: many are flushed together.

A file is written under an interim name.  `UnflushedFiles.flush` flushes its content, gives it its own name,
and flushes the name, too.  Until then its bytes are kept: the kernel discards what it could not write, and
then the file is written again.

A file that was replaced is not deleted but kept as a spare for the next one to write, since file systems take
long to create a file: ext4 looks at every one that was deleted in the last seconds.  It is written over only
when its former name is on the disk as another file's, so that it is not needed whatever happens.
"""

from __future__ import annotations

import contextlib
import threading
from dataclasses import dataclass
from typing import Final

from shmmap.chunks.voxels import ChunkKey
from shmmap.daemon.live.disk.folder import Files, write_beside
from shmmap.daemon.live.disk.map_record import CHUNK
from shmmap.failpoints import step

__all__ = ["UnflushedFiles"]

_ENTRY_BYTES: Final = 1 << 10
"""Memory of an unflushed file beside its content."""


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
    """Unflushed files of one map; used from any thread, but for each chunk from one at a time.

    Attributes
    ----------
    nbytes : int
        Memory that they take in this process.
    """

    def __init__(self, files: Files) -> None:
        self._files = files
        self.nbytes = 0
        self._written: dict[ChunkKey, _Written] = {}
        self._spare: list[str] = []
        self._changing, self._flushing = threading.Lock(), threading.Lock()

    def get(self, key: ChunkKey) -> bytes | None:
        """Return the newest file of a chunk; None where that has its own name."""
        written = self._written.get(key)
        return written.data if written is not None else None

    def write(self, key: ChunkKey, data: bytes) -> None:
        """Write the file of a chunk; if this raises OSError, all is as it was."""
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
            self._remove(obsolete.interim)  # or an older file, which may have its own name on the disk

    def _write(self, data: bytes) -> str:
        """Write a file over a spare one, or a new one; return its name."""
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
        """Make durable what was written, and return it; what is written meanwhile is for the next flush.

        Raises
        ------
        OSError
            Some of it is not on the disk; all of it is written again by the next flush.
        """
        with self._flushing:  # a second caller waits until it is durable
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
        """Give a file its name; return whether the file that had it has the interim one now."""
        try:
            self._files.exchange(interim, name)
        except OSError:  # there is none, or the file system cannot
            self._files.rename(interim, name)
            return False
        return True

    def _note_failure(self, taken: dict[ChunkKey, _Written]) -> None:
        """Note that a flush failed: all of it is written again, except what is replaced by now."""
        with self._changing:
            for key, one in taken.items():
                one.is_flushed, one.failed = False, True
                if self._written.get(key) is not one:
                    self._remove(one.interim)

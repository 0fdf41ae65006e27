# SPDX-License-Identifier: Apache-2.0
"""Files of chunks between being written and being on the disk: many are flushed together.

A file is written under another name than its own.  `UnflushedFiles.flush` has it on the disk, gives it its
name, and has the name on the disk, too.  Until then its bytes are kept: what the kernel could not write it
throws away, and then the file is written anew.
"""

from __future__ import annotations

import contextlib
import threading
from dataclasses import dataclass
from typing import Final

from shmmap.chunks.voxels import ChunkKey
from shmmap.daemon.live.disk.map_record import CHUNK
from shmmap.daemon.live.folder import Files, write_beside
from shmmap.failpoints import step

__all__ = ["UnflushedFiles"]

_ENTRY_BYTES: Final = 1 << 10
"""What a file counts beside its bytes."""


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
    """Those of one map; from any thread, but each chunk from one at a time.

    Parameters
    ----------
    files
        Of the map's directory.

    Attributes
    ----------
    nbytes : int
        What they take in this process.
    """

    def __init__(self, files: Files) -> None:
        self._files = files
        self.nbytes = 0
        self._written: dict[ChunkKey, _Written] = {}
        self._changing, self._flushing = threading.Lock(), threading.Lock()

    def get(self, key: ChunkKey) -> bytes | None:
        """The newest file of a chunk; None where that has its name."""
        written = self._written.get(key)
        return written.data if written is not None else None

    def write(self, key: ChunkKey, data: bytes) -> None:
        """Write the file of a chunk; raises OSError, and then all is as it was."""
        written = _Written(write_beside(self._files, key.text + CHUNK, data), data)
        step("live.written")
        with self._changing:
            before = self._written.get(key)
            self._written[key] = written
            self.nbytes += written.nbytes - (before.nbytes if before is not None else 0)
            needless = before is not None and not before.is_flushed
        if before is not None and needless:
            with contextlib.suppress(OSError):  # it may have its name; else it goes with the next start
                self._files.remove(before.interim)

    def flush(self) -> dict[ChunkKey, bytes]:
        """Make durable what was written, and return it; what comes meanwhile is for the next time.

        Raises
        ------
        OSError
            Some of it is not on the disk; all of it is written anew the next time.
        """
        with self._flushing:  # who comes second waits until it is so
            with self._changing:
                taken = dict(self._written)
                for one in taken.values():
                    one.is_flushed = True
            if not taken:
                return {}
            try:
                for key, one in taken.items():
                    self._sync(key, one)
                step("live.synced")
                for key, one in taken.items():
                    self._files.rename(one.interim, key.text + CHUNK)
                    step("live.renamed")
                self._files.sync_names()
                step("live.flushed")
            except OSError:
                self._keep_for_later(taken)
                raise
            with self._changing:
                for key, one in taken.items():
                    if self._written.get(key) is one:
                        del self._written[key]
                        self.nbytes -= one.nbytes
            return {key: one.data for key, one in taken.items()}

    def _sync(self, key: ChunkKey, one: _Written) -> None:
        if one.failed:
            old, one.interim = one.interim, write_beside(self._files, key.text + CHUNK, one.data)
            with contextlib.suppress(FileNotFoundError):  # it had its name already
                self._files.remove(old)
        self._files.sync(one.interim)

    def _keep_for_later(self, taken: dict[ChunkKey, _Written]) -> None:
        """A flush came to nothing: all of it is written again, but what is newer by now."""
        with self._changing:
            for key, one in taken.items():
                one.is_flushed, one.failed = False, True
                if self._written.get(key) is not one:
                    with contextlib.suppress(OSError):
                        self._files.remove(one.interim)

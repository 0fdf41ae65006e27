# SPDX-License-Identifier: Apache-2.0
"""Chunks in shared memory: made, grown, given up, and found again after the writer died.

A chunk is a file on a tmpfs.  It is mapped once, as long as it can ever get; only as much of that as the file
has may be touched.  Memory is taken from the kernel before it is touched: where there is none, that is an
error here and not a signal later.  A file grows until its chunk is given up, and is cut to nothing then: its
memory is free at once, whatever others have open or mapped.
"""

from __future__ import annotations

import contextlib
import errno
import mmap
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from shmmap.chunks.layout import (
    BRICK_BYTES,
    HEADER_BYTES,
    MOST_BYTES,
    OUT_OF_SERVICE,
    ChunkView,
    chunk_bytes,
    read_identity,
)
from shmmap.chunks.mapping import map_chunk, unmap_chunk, view_at
from shmmap.chunks.voxels import ChunkKey
from shmmap.errors import BadRequest, SegmentCorrupt

__all__ = ["ChunkFile", "ChunkMemory", "live_prefix", "memory_bytes"]

_GROWTH_BRICKS: Final = 8
"""A page: memory comes in pages."""


def live_prefix(instance: str, map_name: str) -> str:
    """Return what the names of a live map's chunks start with, slash included; no segment's name does."""
    return f"/shmmap-live.{instance}.{map_name}."


def memory_bytes(bricks: int) -> int:
    """Memory of a chunk of so many bricks, in whole pages."""
    return chunk_bytes(-(-bricks // _GROWTH_BRICKS) * _GROWTH_BRICKS)


@dataclass(eq=False)
class ChunkFile:
    """One chunk in memory, mapped for writing.

    Attributes
    ----------
    name
        Of the shared memory, slash included: prefix, key, generation.
    generation
        Which time the map had this chunk in memory.
    view
        Arrays over as much as there is.
    """

    name: str
    generation: int
    _fd: int
    _address: int
    view: ChunkView

    @property
    def nbytes(self) -> int:
        """Memory that it takes: what the file has, in whole pages."""
        return -(-len(self.view.data) // mmap.PAGESIZE) * mmap.PAGESIZE

    def grow(self, bricks: int) -> ChunkView:
        """Make room for so many bricks, at least.

        Raises
        ------
        OSError
            The file system is full; the chunk is as it was.
        """
        size = memory_bytes(bricks)
        if size > len(self.view.data):
            os.posix_fallocate(self._fd, 0, size)
            self.view = view_at(self._address, size)
        return self.view

    def unmap(self) -> int:
        """Unmap it; nothing of ``view`` may be used any more.  Returns its descriptor."""
        self.view = ChunkView(bytearray(HEADER_BYTES))
        unmap_chunk(self._address)
        return self._fd

    def close(self) -> None:
        """Unmap it; nothing of ``view`` may be used any more."""
        os.close(self.unmap())


class ChunkMemory:
    """The chunks of one live map in a directory for shared memory.

    Parameters
    ----------
    path
        A directory on a tmpfs, without huge pages: a chunk would take 2 MiB there.
    prefix
        What its names start with, see `live_prefix`.
    mode, gid
        Who may read the chunks; a group of -1 is the process's own.

    Attributes
    ----------
    foreign : set
        Names like those of chunks that are somebody else's files: they are left alone.
    """

    def __init__(self, path: str, prefix: str, *, mode: int = 0o600, gid: int = -1) -> None:
        self._fd = os.open(path, os.O_DIRECTORY | os.O_RDONLY | os.O_CLOEXEC)
        self.prefix = prefix
        self._mode, self._gid = mode, gid
        self.foreign: set[str] = set()

    def close(self) -> None:
        """Leave the directory; what is in it stays."""
        os.close(self._fd)

    def name(self, key: ChunkKey, generation: int) -> str:
        """Return the name of a chunk of one generation."""
        return f"{self.prefix}{key.text}.{generation}"

    def create(self, content: bytes | bytearray) -> ChunkFile:
        """Put a chunk into memory; it has its name when it is whole.

        Parameters
        ----------
        content
            Its header and bricks.

        Raises
        ------
        OSError
            There is no memory, or the name is taken.
        """
        identity = read_identity(content)
        name = self.name(identity.key, identity.generation)
        fd = os.open(".", os.O_TMPFILE | os.O_RDWR | os.O_CLOEXEC, 0o600, dir_fd=self._fd)
        try:
            if os.pwrite(fd, content, 0) != len(content):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            if self._gid >= 0:
                os.fchown(fd, -1, self._gid)
            os.fchmod(fd, self._mode)
            chunk = self._mapped(name, identity.generation, fd, len(content))
        except BaseException:
            os.close(fd)
            raise
        try:
            os.link(
                f"/proc/self/fd/{fd}", name.lstrip("/"), src_dir_fd=self._fd, dst_dir_fd=self._fd,
                follow_symlinks=True,
            )  # fmt: skip
        except BaseException:
            chunk.close()
            raise
        return chunk

    def open(self, name: str) -> ChunkFile:
        """Map a chunk that an earlier writer left.

        Raises
        ------
        SegmentCorrupt
            It is not the chunk that its name says.
        OSError
            It cannot be opened.
        """
        flags = os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
        fd = os.open(name.lstrip("/"), flags, dir_fd=self._fd)
        try:
            size = os.fstat(fd).st_size
            if not HEADER_BYTES <= size <= MOST_BYTES or (size - HEADER_BYTES) % BRICK_BYTES:
                raise SegmentCorrupt(f"{name}: {size} bytes cannot be a chunk")
            identity = read_identity(os.pread(fd, HEADER_BYTES, 0), name)
            if name != self.name(identity.key, identity.generation):
                raise SegmentCorrupt(f"{name}: it is chunk {identity.key.text} {identity.generation}")
            return self._mapped(name, identity.generation, fd, size)
        except BaseException:
            os.close(fd)
            raise

    def _mapped(self, name: str, generation: int, fd: int, size: int) -> ChunkFile:
        address = map_chunk(fd, name, writable=True)
        return ChunkFile(name, generation, fd, address, view_at(address, size))

    def give_up(self, chunk: ChunkFile) -> None:
        """Take a chunk out of service, and free its memory, whatever readers do with it.

        A reader in the middle of it finds another ``sequence``, or less than it needs, and begins again.
        """
        state = chunk.view.state
        state["state"] = OUT_OF_SERVICE
        state["sequence"] += 2
        fd = chunk.unmap()
        try:
            os.ftruncate(fd, 0)  # before its name goes: else a kill here would leave memory without a name
        finally:
            os.close(fd)
        with contextlib.suppress(FileNotFoundError):
            self.remove(chunk.name)

    def is_given_up(self, name: str) -> bool:
        """Whether an earlier writer all but gave up what has this name: nothing is left in it."""
        return os.stat(name.lstrip("/"), dir_fd=self._fd, follow_symlinks=False).st_size == 0

    def names(self) -> Iterator[tuple[str, ChunkKey, int]]:
        """Chunks that there are, with key and generation; what has no such name is left out."""
        pattern = re.compile(re.escape(self.prefix.lstrip("/")) + r"(-?\d+_-?\d+_-?\d+)\.(\d+)")
        for name in sorted(os.listdir(self._fd)):
            if found := pattern.fullmatch(name):
                try:
                    key = ChunkKey.from_text(found[1])
                except BadRequest:
                    continue
                if self._is_ours(name):
                    yield "/" + name, key, int(found[2])
                else:
                    self.foreign.add(name)

    def _is_ours(self, name: str) -> bool:
        """Whether a file belongs to this process's user; in a sticky directory nobody else can replace it."""
        try:
            return os.stat(name, dir_fd=self._fd, follow_symlinks=False).st_uid == os.geteuid()
        except FileNotFoundError:
            return False

    def remove(self, name: str) -> None:
        """Remove the name of what is of no use."""
        os.unlink(name.lstrip("/"), dir_fd=self._fd)

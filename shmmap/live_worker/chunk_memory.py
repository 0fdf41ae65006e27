# SPDX-License-Identifier: Apache-2.0
"""Chunks in shared memory: create, grow and retire them, and find them again after the writer died.

A chunk is a file on a tmpfs.  It is mapped once, with the maximum length of a chunk; only bytes within the
file may be accessed.  (Python's own `mmap` refuses to map more than the file's length.)  Memory is allocated
before it is accessed, so that lack of memory is an error here and not a signal later.  A file grows until its
chunk is evicted, and is then truncated to nothing: its memory is free at once, even if other processes have
it open or mapped.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import mmap
import os
import re
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

from shmmap.chunks.layout import (
    BRICK_BYTES,
    HEADER_BYTES,
    MAX_BYTES,
    OUT_OF_SERVICE,
    ChunkView,
    chunk_bytes,
    read_identity,
)
from shmmap.chunks.voxels import ChunkKey
from shmmap.errors import BadRequest, CannotStart, SegmentCorrupt

_GROWTH_BRICKS: Final = 8
"""Bricks by which a chunk grows: one page, the unit of allocation."""
_RECORDS: Final = ("undo", "applied")
"""Records kept in shared memory as long as any chunk of the map is there."""
_PROT_READ: Final = 0x1
_PROT_WRITE: Final = 0x2
_MAP_SHARED: Final = 0x1
_FAILED: Final = ctypes.c_void_p(-1).value

_libc: Any = ctypes.CDLL(None, use_errno=True)
_libc.mmap.restype = ctypes.c_void_p
_libc.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, *[ctypes.c_int] * 3, ctypes.c_long]
_libc.munmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t]


def live_prefix(instance: str, map_name: str) -> str:
    """Return the prefix of the names of a live map's chunks, slash included; no segment's name has it."""
    return f"/shmmap-live.{instance}.{map_name}."


def memory_bytes(bricks: int) -> int:
    """Return the memory of a chunk with this many bricks, in whole pages."""
    return chunk_bytes(-(-bricks // _GROWTH_BRICKS) * _GROWTH_BRICKS)


def map_chunk(fd: int, name: str) -> int:
    """Map the file of a chunk for writing; return the address.

    Raises
    ------
    OSError
        The process has no room for more mappings, or the file may not be mapped for writing.
    """
    address = _libc.mmap(None, MAX_BYTES, _PROT_READ | _PROT_WRITE, _MAP_SHARED, fd, 0)
    if address == _FAILED:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number), name)
    return int(address)


def view_at(address: int, size: int) -> ChunkView:
    """Return arrays over the first bytes of a mapped chunk; they do not keep it mapped."""
    return ChunkView((ctypes.c_char * size).from_address(address))


@dataclass(eq=False)
class ChunkFile:
    """One chunk in memory, mapped for writing.

    Attributes
    ----------
    name
        Name of the shared memory, slash included: prefix, key, generation.
    generation
        Increases each time that the map loads this chunk into memory.
    view
        Arrays over the bytes of the file.
    """

    name: str
    generation: int
    _fd: int
    _address: int
    view: ChunkView

    @property
    def nbytes(self) -> int:
        """Memory of the chunk: the file's length in whole pages."""
        return -(-len(self.view.data) // mmap.PAGESIZE) * mmap.PAGESIZE

    def grow(self, bricks: int) -> ChunkView:
        """Make room for at least this many bricks.

        Raises
        ------
        OSError
            The file system is full; the chunk is unchanged.
        """
        size = memory_bytes(bricks)
        if size > len(self.view.data):
            os.posix_fallocate(self._fd, 0, size)
            self.view = view_at(self._address, size)
        return self.view

    def unmap(self) -> int:
        """Unmap the chunk, after which ``view`` must not be used; return its descriptor."""
        self.view = ChunkView(bytearray(HEADER_BYTES))
        _libc.munmap(self._address, MAX_BYTES)
        return self._fd

    def close(self) -> None:
        """Unmap and close the chunk, after which ``view`` must not be used."""
        os.close(self.unmap())


class ChunkMemory:
    """The chunks of one live map in a directory for shared memory.

    Parameters
    ----------
    path
        A directory on a tmpfs without huge pages, with which each chunk would take 2 MiB.
    prefix
        Prefix of the chunks' names, see `live_prefix`.
    gid
        Group that may read the chunks' files; -1: no group.

    Attributes
    ----------
    foreign : set
        Names of files that look like chunks but belong to another user; they are ignored.
    """

    def __init__(self, path: str, prefix: str, gid: int = -1) -> None:
        self._fd = os.open(path, os.O_DIRECTORY | os.O_RDONLY | os.O_CLOEXEC)
        self.path = path
        self.prefix = prefix
        self._gid = gid
        self.foreign: set[str] = set()

    def close(self) -> None:
        """Close the directory; chunks stay, and the records as long as there are chunks."""
        if not list(self.names()):
            for name in _RECORDS:
                with contextlib.suppress(FileNotFoundError):
                    self.remove(self.prefix + name)
        os.close(self._fd)

    def name(self, key: ChunkKey, generation: int) -> str:
        """Return the name of a chunk of one generation."""
        return f"{self.prefix}{key.text}.{generation}"

    def give_access(self, fd: int) -> None:
        """Give a file the permissions of the chunks' files."""
        if self._gid >= 0:
            os.fchown(fd, -1, self._gid)
        os.fchmod(fd, 0o640 if self._gid >= 0 else 0o600)

    def record(self, name: str, nbytes: int) -> mmap.mmap:
        """Map a file that outlives this process; create it filled with zeros if it does not exist.

        Raises
        ------
        CannotStart
            Something else has its name, or a file of another user.
        """
        path = self.path + self.prefix + name
        flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
        fd = os.open(path, flags, 0o600)
        try:
            status = os.fstat(fd)
            if not stat.S_ISREG(status.st_mode) or status.st_uid != os.geteuid():
                raise CannotStart(
                    f"{path} is not a file of this user, but of user {status.st_uid}",
                    hint="remove it, or choose another name for the instance",
                )
            os.posix_fallocate(fd, 0, nbytes)
            return mmap.mmap(fd, nbytes)
        finally:
            os.close(fd)

    def create(self, content: bytes | bytearray) -> ChunkFile:
        """Create a chunk in memory; it gets its name when it is complete.

        Parameters
        ----------
        content
            Header and bricks of the chunk.

        Raises
        ------
        OSError
            There is no memory, or the name is taken.
        """
        identity = read_identity(content)
        name = self.name(identity.key, identity.generation)
        fd = os.open(".", os.O_TMPFILE | os.O_RDWR | os.O_CLOEXEC, 0o600, dir_fd=self._fd)
        with contextlib.ExitStack() as undo:
            undo.callback(os.close, fd)
            if os.pwrite(fd, content, 0) != len(content):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            self.give_access(fd)
            chunk = self._mapped(name, identity.generation, fd, len(content))
            undo.callback(chunk.unmap)
            os.link(f"/proc/self/fd/{fd}", name.lstrip("/"), dst_dir_fd=self._fd, follow_symlinks=True)
            undo.pop_all()
        return chunk

    def open(self, name: str) -> ChunkFile:
        """Map a chunk that a previous writer left.

        Raises
        ------
        SegmentCorrupt
            The file is not the chunk that its name denotes.
        OSError
            It cannot be opened.
        """
        flags = os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
        fd = os.open(name.lstrip("/"), flags, dir_fd=self._fd)
        try:
            size = os.fstat(fd).st_size
            if not HEADER_BYTES <= size <= MAX_BYTES or (size - HEADER_BYTES) % BRICK_BYTES:
                raise SegmentCorrupt(f"{name}: {size} bytes cannot be a chunk")
            identity = read_identity(os.pread(fd, HEADER_BYTES, 0), name)
            if name != self.name(identity.key, identity.generation):
                raise SegmentCorrupt(f"{name}: it is chunk {identity.key.text} {identity.generation}")
            return self._mapped(name, identity.generation, fd, size)
        except BaseException:
            os.close(fd)
            raise

    def _mapped(self, name: str, generation: int, fd: int, size: int) -> ChunkFile:
        address = map_chunk(fd, name)
        return ChunkFile(name, generation, fd, address, view_at(address, size))

    def give_up(self, chunk: ChunkFile) -> None:
        """Evict a chunk and free its memory, even while readers use it.

        A reader in the middle of the chunk finds another ``sequence`` or too few bytes, and starts again.
        """
        state = chunk.view.state
        state["state"] = OUT_OF_SERVICE
        state["sequence"] += 2
        fd = chunk.unmap()
        try:
            os.ftruncate(fd, 0)  # before the name is removed: a kill here must not leave unnamed memory
        finally:
            os.close(fd)
        with contextlib.suppress(FileNotFoundError):
            self.remove(chunk.name)

    def is_given_up(self, name: str) -> bool:
        """Return whether a previous writer evicted the chunk of this name, and only the name is left."""
        return os.stat(name.lstrip("/"), dir_fd=self._fd, follow_symlinks=False).st_size == 0

    def names(self) -> Iterator[tuple[str, ChunkKey, int]]:
        """Yield the name, key and generation of each chunk in the directory."""
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
        """Return whether this user owns a file; in a sticky directory no other user can replace it."""
        try:
            return os.stat(name, dir_fd=self._fd, follow_symlinks=False).st_uid == os.geteuid()
        except FileNotFoundError:
            return False

    def remove(self, name: str) -> None:
        """Remove an unusable file."""
        os.unlink(name.lstrip("/"), dir_fd=self._fd)

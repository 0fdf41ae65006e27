# SPDX-License-Identifier: Apache-2.0
"""Attaching to a segment: read-only numpy views over shared memory.

A mapping lives exactly as long as any array over it: every view's ``base`` chain ends at the
mapping object, whose end unmaps.  Nothing is ever unmapped under a live view.  No file descriptor
is kept (Python's own ``mmap`` keeps one each, which ends at RLIMIT_NOFILE), so the mapping is made
with the C library's ``mmap``; the kernel keeps the open file, and the session's lock on it, for as
long as the mapping lives.  Neither is lost to an exception that comes at the wrong moment
(`shmmap.segment.owned`).
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import stat
import time
from collections.abc import Callable, Iterable
from functools import partial
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import posix_ipc

from shmmap.errors import SegmentCorrupt, SegmentError, StaleHandle
from shmmap.failpoints import step
from shmmap.optional_packages import needed_packages
from shmmap.segment.directory import DEFAULT_SHM_DIR
from shmmap.segment.header import OUTSIDE, OUTSIDE_AT, read_columns, unpack_header
from shmmap.segment.layout import PAGE_BYTES, ColumnRow, SegmentHeader
from shmmap.segment.owned import Owned
from shmmap.segment.pins import lock_slot
from shmmap.segment.publish_block import PublishBlock, unpack_publish_block

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["AttachedSegment", "OnUnmap", "attach", "map_file"]

OnUnmap = Callable[[Owned], object]

LEASE_S: Final = 0.2
"""How long a lease may keep an open waiting; the daemon holds one for microseconds."""
LEASE_RETRY_S: Final = 0.0002

_libc: Final = ctypes.CDLL(None, use_errno=True)
_mmap: Final = _libc.mmap
_mmap.restype = ctypes.c_void_p
_mmap.argtypes = (
    ctypes.c_void_p,
    ctypes.c_size_t,
    ctypes.c_int,
    ctypes.c_int,
    ctypes.c_int,
    ctypes.c_long,
)
_munmap: Final = _libc.munmap
_munmap.argtypes = (ctypes.c_void_p, ctypes.c_size_t)

_PROT_READ: Final = 1
_MAP_SHARED: Final = 1
_MAP_POPULATE: Final = 0x8000
_MAP_FAILED: Final = ctypes.c_void_p(-1).value


def map_file(fd: int, nbytes: int, *, populate: bool = False) -> Owned:
    """Map a file's first bytes; they are unmapped when the result ends, whose value is their address.

    Raises
    ------
    SegmentError
        The kernel refuses.
    """
    flags = _MAP_SHARED | (_MAP_POPULATE if populate else 0)
    given = map(_mmap, (None,), (nbytes,), (_PROT_READ,), (flags,), (fd,), (0,))
    memory = Owned(zip(given, (nbytes,), strict=True), _munmap)
    if memory.value == _MAP_FAILED or memory.value is None:
        number = ctypes.get_errno()
        raise SegmentError(
            f"cannot map {nbytes} bytes: {os.strerror(number)}",
            hint="vm.max_map_count, or the limit of address space (ulimit -v), may be too low",
        )
    memory.keep(partial(_munmap, memory.value, nbytes))
    return memory


class _Mapping:
    """Has mapped memory as long as any array over it lives: the root of the base chain of all of them."""

    __slots__ = ("__array_interface__", "_memory", "_on_unmap")

    def __init__(self, memory: Owned, nbytes: int, on_unmap: OnUnmap | None) -> None:
        self._memory = memory
        self._on_unmap = on_unmap
        # True: read-only; numpy then refuses to make any view of it writeable
        self.__array_interface__ = {
            "data": (memory.value, True),
            "shape": (nbytes,),
            "typestr": "|u1",
            "version": 3,
        }

    def __del__(self) -> None:
        on_unmap = getattr(self, "_on_unmap", None)
        if on_unmap is not None:
            on_unmap(self._memory)


class AttachedSegment:
    """A verified, read-only view of one segment.

    Attributes
    ----------
    columns : list of tuple
        The column table (`shmmap.segment.layout.ColumnRow`).
    raw : (total_bytes,) uint8
        All of its bytes.
    """

    __slots__ = ("_header", "columns", "raw")

    def __init__(self, columns: list[ColumnRow], raw: NDArray[np.uint8]) -> None:
        self.columns = columns
        self.raw = raw
        self._header: SegmentHeader | None = None

    @property
    def header(self) -> SegmentHeader:
        """What the segment says about itself; read when first asked for."""
        header = self._header
        if header is None:
            header = self._header = unpack_header(self.raw.data, len(self.raw))
        return header

    @property
    def outside_points(self) -> int:
        """Points outside the cell's box; cheaper than the header."""
        return int(OUTSIDE.unpack_from(self.raw.data, OUTSIDE_AT)[0])

    def column(self, index: int) -> NDArray[np.generic]:
        """Return column number ``index`` as a read-only, zero-copy array."""
        _name, dtype, shape, offset, _nbytes, _unit, _checksum = self.columns[index]
        view: NDArray[np.generic] = np.ndarray(shape, dtype, self.raw, offset)
        return view

    @property
    def published(self) -> PublishBlock | None:
        """The publish block; None for bytes that no daemon published."""
        return unpack_publish_block(self.raw.data, self.header.header_bytes)

    def verify(self) -> None:
        """Check every column against its checksum (about 10 ms per 100 MB).

        Raises
        ------
        SegmentCorrupt
            Naming the first column whose bytes changed.
        """
        with needed_packages("verify()"):
            import xxhash

        for column in self.header.columns:
            if (
                xxhash.xxh3_64_intdigest(self.raw[column.offset : column.offset + column.nbytes].data)
                != column.checksum
            ):
                raise SegmentCorrupt(
                    f"column {column.name!r} of {self.header.cell_id} does not match its checksum"
                )


_open_shared: Final = partial(posix_ipc.SharedMemory, flags=os.O_NONBLOCK, read_only=True)
"""No size=: passing one would resize the segment under everybody's feet."""
_fd_of: Final = attrgetter("fd")
_FLAGS: Final = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK


def _open(name: str, shm_dir: str) -> Owned:
    """Open a segment, never waiting: a pipe that has its name by now would make the opener wait for ever."""
    fds: Iterable[Any]
    if shm_dir == DEFAULT_SHM_DIR:
        fds = map(_fd_of, map(_open_shared, (name,)))
    else:
        fds = map(os.open, (f"{shm_dir}/{name.lstrip('/')}",), (_FLAGS,))
    return Owned(zip(fds), os.close)


def _open_soon(name: str, shm_dir: str) -> Owned:
    """Open a segment on which the daemon has a lease, held for a moment to see whether anybody uses it."""
    end_s = time.monotonic() + LEASE_S
    while True:
        try:
            return _open(name, shm_dir)
        except BlockingIOError:  # noqa: PERF203  it is the only way to find out
            if time.monotonic() > end_s:
                raise
            time.sleep(LEASE_RETRY_S)


def attach(
    name: str,
    *,
    offset: int = 0,
    nbytes: int = 0,
    shm_dir: str = DEFAULT_SHM_DIR,
    slot: int | None = None,
    owner: int | None = None,
    populate: bool = False,
    on_unmap: OnUnmap | None = None,
    on_mapped: Callable[[Owned], object] | None = None,
) -> AttachedSegment:
    """Map a segment read-only and verify its header.

    Parameters
    ----------
    name
        As a handle gives it, leading slash included.
    offset, nbytes
        Where in the shared-memory object the segment lies; 0 bytes means all of it.
    shm_dir
        Directory of the segments, as the daemon's ``hello`` names it.
    slot
        The session's slot: tells the daemon who uses the segment.
    owner
        User that the segment must belong to: where everybody may make files, a name that the daemon
        gave up may be anybody's by now.
    populate
        Let the kernel map every page now (``MAP_POPULATE``) instead of at first touch.
    on_unmap
        Is given the memory when the last array over it is gone; it is unmapped when nobody has it any
        more, on the spot as a rule.
    on_mapped
        Is given the memory as soon as it is mapped; not to be kept.

    Raises
    ------
    StaleHandle
        The segment is gone, or what has its name is something else or somebody else's.
    SegmentCorrupt
        Its bytes are not a segment of a layout this program reads.
    SegmentError
        It may not be opened by this user, or cannot be mapped.
    """
    try:
        try:
            file = _open(name, shm_dir)
        except BlockingIOError:
            file = _open_soon(name, shm_dir)
    except (FileNotFoundError, posix_ipc.ExistentialError) as error:
        raise StaleHandle(f"segment {name} is gone", hint="ask the daemon again") from error
    except (PermissionError, posix_ipc.PermissionsError) as error:
        raise SegmentError(
            f"segment {name}: this user may not read it",
            hint="join the group that the daemon was started with (--group)",
        ) from error
    except BlockingIOError as error:
        raise StaleHandle(
            f"segment {name} cannot be opened: its lease is not given back", hint="ask the daemon again"
        ) from error
    except OSError as error:
        raise SegmentError(f"segment {name}: {error.strerror}") from error
    fd = file.value
    try:
        step("client.open")
        status = os.fstat(fd)
        if not stat.S_ISREG(status.st_mode) or owner not in (None, status.st_uid):
            raise StaleHandle(
                f"segment {name} is gone: its name is that of a file of user {status.st_uid} now",
                hint="ask the daemon again",
            )
        if slot is not None:
            with contextlib.suppress(OSError):  # it is as safe without; only its user is not known
                lock_slot(fd, slot)
        step("client.lock")
        available = status.st_size
        end = offset + nbytes if nbytes else available
        if end > available or end == 0:
            raise SegmentCorrupt(f"segment {name} has {available} bytes, the daemon's handle says {end}")
        size = end - offset
        # Reading the header is cheaper than the page fault that looking at it would cost
        page = os.pread(fd, min(size, PAGE_BYTES), offset)
        header_bytes = int.from_bytes(page[16:24], "little")
        if PAGE_BYTES < header_bytes <= size:
            page = os.pread(fd, header_bytes, offset)
        _, columns = read_columns(memoryview(page), size)
        memory = map_file(fd, end, populate=populate)
        if on_mapped is not None:
            on_mapped(memory)
        step("client.map")
    except OSError as error:
        raise SegmentError(f"segment {name} cannot be read: {error.strerror}") from error
    finally:
        file.give_back()
    mapping = _Mapping(memory, end, on_unmap)
    raw: NDArray[np.uint8] = np.asarray(mapping)
    del mapping.__array_interface__  # it has done its work, and windows have hundreds of mappings
    if offset:
        raw = raw[offset:]
    return AttachedSegment(columns, raw)

# SPDX-License-Identifier: Apache-2.0
"""Attaching to a segment: read-only numpy views over shared memory.

A mapping lives exactly as long as any array over it: every view's ``base`` chain ends at the
mapping object, whose end unmaps.  Nothing is ever unmapped under a live view.  No file descriptor
is kept (Python's own ``mmap`` keeps one each, which ends at RLIMIT_NOFILE), so the mapping is made
with the C library's ``mmap``; the kernel keeps the open file, and the session's lock on it, for as
long as the mapping lives.  Neither is lost to an exception that comes at the wrong moment (`Owned`).
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import stat
import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import starmap
from operator import attrgetter
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import posix_ipc

from shmmap.errors import SegmentCorrupt, SegmentError, StaleHandle
from shmmap.failpoints import step
from shmmap.lazy_imports import needed_packages
from shmmap.segment.directory import DEFAULT_SHM_DIR
from shmmap.segment.header import (
    OUTSIDE,
    OUTSIDE_AT,
    PublishBlock,
    read_columns,
    read_page,
    unpack_header,
    unpack_publish_block,
)
from shmmap.segment.layout import PAGE_BYTES, ColumnRow, SegmentHeader
from shmmap.segment.names import retired_name
from shmmap.segment.pins import lock_slot
from shmmap.segment.process_limits import no_files_left, no_memory_left

if TYPE_CHECKING:
    from numpy.typing import NDArray


__all__ = ["AttachedSegment", "Owned", "attach", "attach_writable", "map_file"]


class Owned:
    """One thing that a built-in function gives and another one takes back when this object ends.

    It is given back whatever exception a signal handler raises wherever.  Python runs signal handlers between
    the steps of its interpreter, as a rule after a call.  So a handler's exception may come when a function
    has returned a descriptor that no variable holds yet; or at the first step of a ``__del__`` written in
    Python, which then does nothing.  Between functions that are built in and call each other no handler runs:
    taking, keeping and giving back are made of those alone.

    Parameters
    ----------
    given
        Yields one tuple, whose first is the thing: a `zip` of a `map` of the built-in function that gives it.
    take_back
        Built in, too; is called with what is in the tuple, once, and then returns None or 0.

    Raises
    ------
    Exception
        What the giving function raises.
    """

    __slots__ = ("__del__", "__weakref__", "value")

    __del__: Callable[[], object]  # in a slot: what Python calls is built in, and no function of ours

    def __init__(self, given: Iterable[tuple[Any, ...]], take_back: Callable[..., Any]) -> None:
        kept: list[tuple[Any, ...]] = []
        # each in the list is taken back once, since an iterator is at an end after that
        self.__del__ = partial(any, starmap(take_back, kept))
        kept.extend(given)
        self.value = kept[0][0]
        """What was given."""

    def keep(self, take_back: Callable[[], object]) -> None:
        """Need less memory from now on: ``take_back``, built in, does all when this object ends."""
        self.__del__ = take_back

    def give_back(self) -> None:
        """Give it back now, not only when this object ends; not after `keep`."""
        self.__del__()

    def end(self) -> None:
        """Give it back now although this object is still referred to; in a thread without signal handlers."""
        take_back, self.__del__ = self.__del__, bool  # which does nothing
        take_back()


LEASE_S: Final = 0.2
"""How long a lease may keep an open waiting; the daemon holds one for microseconds."""
LEASE_RETRY_S: Final = 0.0002

_libc: Final = ctypes.CDLL(None, use_errno=True)
_mmap: Final = _libc.mmap
_mmap.restype = ctypes.c_void_p
_mmap.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int, ctypes.c_int, ctypes.c_int, ctypes.c_long)
_munmap: Final = _libc.munmap
_munmap.argtypes = (ctypes.c_void_p, ctypes.c_size_t)

_PROT_READ: Final = 1
_PROT_WRITE: Final = 2
_MAP_SHARED: Final = 1
_MAP_PRIVATE: Final = 2
_MAP_NORESERVE: Final = 0x4000
_MAP_POPULATE: Final = 0x8000
_MAP_FAILED: Final = ctypes.c_void_p(-1).value


def map_file(fd: int, nbytes: int, *, populate: bool = False, private: bool = False) -> Owned:
    """Map a file's first bytes; they are unmapped when the result ends, whose value is their address.

    Parameters
    ----------
    fd, nbytes
        The file, open for reading, and how much of it.
    populate
        Let the kernel map every page now.
    private
        Readable and writable: the kernel copies a page at its first write, which only this process sees.

    Raises
    ------
    SegmentError
        The kernel refuses.
    """
    if private:
        protection, flags = _PROT_READ | _PROT_WRITE, _MAP_PRIVATE | _MAP_NORESERVE
    else:
        protection, flags = _PROT_READ, _MAP_SHARED
    if populate:
        flags |= _MAP_POPULATE
    given = map(_mmap, (None,), (nbytes,), (protection,), (flags,), (fd,), (0,))
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
    """Has mapped memory as long as any array over it lives: the root of the base chain of all of them.

    The last view is dropped in any thread and in the middle of anything, so what happens then is made of
    built-in functions alone: no signal handler runs in it, whose exception Python would have to ignore.
    """

    __slots__ = ("__array_interface__", "__del__", "_beside")

    __del__: Callable[[], object]

    def __init__(
        self,
        memory: Owned,
        nbytes: int,
        sinks: Sequence[SimpleQueue[Owned | None]],
        beside: NDArray[np.uint8] | None,
    ) -> None:
        # a private mapping keeps the first one, by which the daemon knows the segment's user
        self._beside = beside
        # True: read-only; numpy then refuses to make any view of it writeable
        self.__array_interface__ = {
            "data": (memory.value, beside is None),
            "shape": (nbytes,),
            "typestr": "|u1",
            "version": 3,
        }
        # into the first of the queues that there are then; where there is none, it is unmapped here
        self.__del__ = partial(any, map(SimpleQueue.put, sinks, (memory,)))


def _bytes_of(
    memory: Owned,
    offset: int,
    end: int,
    *,
    sinks: Sequence[SimpleQueue[Owned | None]] = (),
    beside: NDArray[np.uint8] | None = None,
) -> NDArray[np.uint8]:
    """Return mapped memory as an array that keeps it mapped."""
    mapping = _Mapping(memory, end, sinks, beside)
    raw: NDArray[np.uint8] = np.asarray(mapping)
    del mapping.__array_interface__  # it has done its work, and windows have hundreds of mappings
    return raw[offset:] if offset else raw


class AttachedSegment:
    """A verified view of one segment, read-only as a rule.

    ``raw`` (total_bytes,) uint8 is all of its bytes; ``outside_points`` lie outside the cell's box.
    """

    __slots__ = ("_header", "columns", "outside_points", "raw")

    def __init__(self, columns: list[ColumnRow], raw: NDArray[np.uint8], outside_points: int = 0) -> None:
        self.columns = columns
        self.raw = raw
        self.outside_points = outside_points
        self._header: SegmentHeader | None = None

    @property
    def header(self) -> SegmentHeader:
        """What the segment says about itself; read when first asked for."""
        header = self._header
        if header is None:
            header = self._header = unpack_header(self.raw.data, len(self.raw))
        return header

    def column(self, index: int) -> NDArray[np.generic]:
        """Return column number ``index`` as a zero-copy array."""
        _name, dtype, shape, offset, _nbytes, _unit, _checksum = self.columns[index]
        view: NDArray[np.generic] = np.ndarray(shape, dtype, self.raw, offset)
        return view

    @property
    def published(self) -> PublishBlock | None:
        """The publish block; None for bytes that no daemon published."""
        return unpack_publish_block(self.raw.data, self.header.header_bytes)

    def copy(self) -> AttachedSegment:
        """Return the same in memory of this process alone, which may be written.

        Raises
        ------
        LimitReached
            There is not so much memory.
        """
        try:
            return AttachedSegment(self.columns, self.raw.copy(), self.outside_points)
        except MemoryError:
            raise no_memory_left(len(self.raw)) from None

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
"""No size=: passing one would resize the segment."""
_fd_of: Final = attrgetter("fd")
_FLAGS: Final = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK


def _open(name: str, shm_dir: str) -> Owned:
    """Open a segment, never waiting: a pipe that has its name by now would block the opener."""
    fds: Iterable[Any]
    if shm_dir == DEFAULT_SHM_DIR:
        fds = map(_fd_of, map(_open_shared, (name,)))
    else:
        fds = map(os.open, (f"{shm_dir}/{name.lstrip('/')}",), (_FLAGS,))
    return Owned(zip(fds), os.close)


def _open_soon(name: str, shm_dir: str) -> Owned:
    """Open a segment on which the daemon has a lease, held for a moment to see whether it is in use."""
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
    sinks: Sequence[SimpleQueue[Owned | None]] = (),
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
        The session's slot, by which the daemon knows the segment's user.
    owner
        User that the segment must belong to: where any account may make files, a name that the daemon
        gave up may be another one's by now.
    populate
        Let the kernel map every page now (``MAP_POPULATE``) instead of at first touch.
    sinks
        The first of these queues gets the memory when the last array over it is gone, to unmap it in a
        thread; they may change at any time.  Without any it is unmapped on the spot.
    on_mapped
        Is given the memory as soon as it is mapped; not to be kept.

    Raises
    ------
    StaleHandle
        The segment is gone, or its name is another file's by now.
    SegmentCorrupt
        Its bytes are not a segment of a layout this program reads.
    SegmentError
        It may not be opened by this user, or cannot be mapped.
    LimitReached
        This process may open no more files.
    """
    try:
        try:
            file = _open(name, shm_dir)
        except BlockingIOError:
            file = _open_soon(name, shm_dir)
    except (FileNotFoundError, posix_ipc.ExistentialError):
        raise StaleHandle(f"segment {name} is gone", hint="ask the daemon again") from None
    except (PermissionError, posix_ipc.PermissionsError):
        raise SegmentError(
            f"segment {name}: this user may not read it",
            hint="join the group that the daemon was started with (--group)",
        ) from None
    except BlockingIOError:
        raise StaleHandle(
            f"segment {name} cannot be opened: its lease is not given back", hint="ask the daemon again"
        ) from None
    except (OSError, posix_ipc.Error) as error:  # posix_ipc raises some without a number
        raise no_files_left(error) or SegmentError(f"segment {name}: {_reason(error)}") from None
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
        # reading the header is cheaper than the page fault that looking at it would cost
        page = read_page(fd, size, offset)
        _, columns = read_columns(memoryview(page), size)
        (outside,) = OUTSIDE.unpack_from(page, OUTSIDE_AT)
        memory = map_file(fd, end, populate=populate)
        if on_mapped is not None:
            on_mapped(memory)
        step("client.map")
    except OSError as error:
        raise SegmentError(f"segment {name} cannot be read: {_reason(error)}") from None
    finally:
        file.give_back()
    return AttachedSegment(columns, _bytes_of(memory, offset, end, sinks=sinks), outside)


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)


def attach_writable(
    segment: AttachedSegment, name: str, *, offset: int = 0, shm_dir: str = DEFAULT_SHM_DIR
) -> AttachedSegment:
    """Return a view of a segment that may be written, for libraries that know no read-only memory.

    It is a second mapping, private and copy-on-write: it is read without a copy, a page that is written
    becomes the process's own, and neither the segment nor any other view changes.  Where the kernel does not
    allow that (the limit of data, ``ulimit -d``) or the segment has no name any more, it is a copy.

    Parameters
    ----------
    segment
        As it is attached; stays so as long as the result's arrays.
    name, offset, shm_dir
        As it was attached by, see `attach`; a retired segment is found, too.

    Raises
    ------
    LimitReached
        A copy is needed, and there is not so much memory.
    """
    for path in (name, retired_name(name)):
        try:
            file = _open_soon(path, shm_dir)
        except (OSError, posix_ipc.Error):
            continue
        try:
            with contextlib.suppress(SegmentError, OSError):
                raw = _same_bytes(segment, file.value, offset)
                if raw is not None:
                    return AttachedSegment(segment.columns, raw)
        finally:
            file.give_back()
    return segment.copy()


def _same_bytes(segment: AttachedSegment, fd: int, offset: int) -> NDArray[np.uint8] | None:
    """Map a file privately; None where it is not the segment's own."""
    first = segment.raw
    end = offset + len(first)
    head = min(len(first), PAGE_BYTES)
    if os.fstat(fd).st_size < end or os.pread(fd, head, offset) != first[:head].tobytes():
        return None
    return _bytes_of(map_file(fd, end, private=True), offset, end, beside=first)

# SPDX-License-Identifier: Apache-2.0
"""Attach to a segment: read-only numpy views over shared memory.

A mapping lives exactly as long as any array over it: every view's ``base`` chain ends at the mapping object,
whose finalizer unmaps.  No memory is unmapped under a live view.  No file descriptor is kept: Python's own
``mmap`` keeps one per mapping, up to RLIMIT_NOFILE, so the C library's ``mmap`` is used.  The kernel keeps
the open file, and the session's lock on it, as long as the mapping lives.  An exception at a bad moment leaks
neither (`Owned`).
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
from shmmap.segment.names import DEFAULT_SHM_DIR, retired_name
from shmmap.segment.pins import lock_slot
from shmmap.segment.process_limits import no_files_left, no_memory_left

if TYPE_CHECKING:
    from numpy.typing import NDArray


class Owned:
    """A resource that one built-in function acquires, and another releases when this object ends.

    The resource is released whatever exception a signal handler raises, and wherever.  Python runs signal
    handlers between interpreter steps, usually after a call.  So a handler's exception may arrive when a
    function has returned a descriptor that no variable holds yet, or at the first step of a ``__del__``
    written in Python, which then does nothing.  No handler runs between built-in functions that call each
    other; acquiring, holding and releasing use only those.

    Parameters
    ----------
    given
        Yields one tuple, whose first element is the resource: a `zip` of a `map` of the acquiring built-in
        function.
    take_back
        Built-in function that releases the resource.  Called once with the elements of the tuple; returns
        None or 0.

    Raises
    ------
    Exception
        As the acquiring function raises.
    """

    __slots__ = ("__del__", "__weakref__", "value")

    __del__: Callable[[], object]  # in a slot: Python calls a built-in function, not Python code

    def __init__(self, given: Iterable[tuple[Any, ...]], take_back: Callable[..., Any]) -> None:
        kept: list[tuple[Any, ...]] = []
        # each element of the list is released once, since its iterator is exhausted after that
        self.__del__ = partial(any, starmap(take_back, kept))
        kept.extend(given)
        self.value = kept[0][0]
        """The resource."""

    def keep(self, take_back: Callable[[], object]) -> None:
        """Replace the release by ``take_back``, a built-in function, to save memory."""
        self.__del__ = take_back

    def give_back(self) -> None:
        """Release the resource now, not only when this object ends; not allowed after `keep`."""
        self.__del__()

    def end(self) -> None:
        """Release the resource although still referenced; only in a thread without signal handlers."""
        take_back, self.__del__ = self.__del__, bool  # which does nothing
        take_back()


LEASE_S: Final = 0.2
"""How long a lease may delay an open; the daemon holds a lease for microseconds."""
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
    """Map a file's first bytes; the result's value is their address, and its end unmaps them.

    Parameters
    ----------
    fd, nbytes
        The file, open for reading, and the number of bytes to map.
    populate
        Map every page now, not at first access.
    private
        Make the mapping writable, copy-on-write: only this process sees its writes.

    Raises
    ------
    SegmentError
        The kernel refuses the mapping.
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
    """Owner of mapped memory, alive as long as any array over it: the root of all their base chains.

    The last view may be dropped in any thread, at any moment.  So the release uses only built-in functions:
    no signal handler can run in it and raise an exception that Python would have to ignore.
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
        # a private mapping keeps the first mapping alive, whose lock identifies the user to the daemon
        self._beside = beside
        # True: read-only; numpy then refuses to make any view of it writeable
        self.__array_interface__ = {
            "data": (memory.value, beside is None),
            "shape": (nbytes,),
            "typestr": "|u1",
            "version": 3,
        }
        # put into the first queue of that moment; without a queue, unmapped here
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
    del mapping.__array_interface__  # not needed any more, and windows have hundreds of mappings
    return raw[offset:] if offset else raw


class AttachedSegment:
    """A verified view of one segment, usually read-only.

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
        """The segment's header, read at the first access."""
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
        """The publish block; None if no daemon published the segment."""
        return unpack_publish_block(self.raw.data, self.header.header_bytes)

    def copy(self) -> AttachedSegment:
        """Return a writable copy in private memory.

        Raises
        ------
        LimitReached
            There is not enough memory.
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
            A column's bytes changed; the message names the first such column.
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
    """Open a segment without blocking, even if a pipe has its name by now."""
    fds: Iterable[Any]
    if shm_dir == DEFAULT_SHM_DIR:
        fds = map(_fd_of, map(_open_shared, (name,)))
    else:
        fds = map(os.open, (f"{shm_dir}/{name.lstrip('/')}",), (_FLAGS,))
    return Owned(zip(fds), os.close)


def _open_soon(name: str, shm_dir: str) -> Owned:
    """Open a segment, retrying while the daemon holds its short lease that checks for users."""
    end_s = time.monotonic() + LEASE_S
    while True:
        try:
            return _open(name, shm_dir)
        except BlockingIOError:  # noqa: PERF203  the only way to detect the lease
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
        Name from a handle, leading slash included.
    offset, nbytes
        Position of the segment in the shared-memory object, bytes; 0 ``nbytes`` means the whole object.
    shm_dir
        Directory of the segments, as `Welcome` reports it.
    slot
        The session's slot, which identifies the user to the daemon.
    owner
        User id that must own the segment.  In a directory that any account may write, a name that the daemon
        released may be another account's file by now.
    populate
        Map every page now (``MAP_POPULATE``), not at first access.
    sinks
        The first of these queues receives the memory when the last array over it is gone, to unmap it in a
        thread. They may change at any time.  Without a queue the memory is unmapped on the spot.
    on_mapped
        Called with the memory as soon as it is mapped; must not keep a reference.

    Raises
    ------
    StaleHandle
        The segment is gone, or another file has its name by now.
    SegmentCorrupt
        The bytes are not a segment of a layout that this program reads.
    SegmentError
        This user may not open the segment, or it cannot be mapped.
    LimitReached
        This process has no more file descriptors.
    """
    try:
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
    except (OSError, posix_ipc.Error) as error:  # posix_ipc raises some errors without errno
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
            with contextlib.suppress(OSError):  # safe without the lock; only the user stays unidentified
                lock_slot(fd, slot)
        step("client.lock")
        available = status.st_size
        end = offset + nbytes if nbytes else available
        if end > available or end == 0:
            raise SegmentCorrupt(f"segment {name} has {available} bytes, the daemon's handle says {end}")
        size = end - offset
        # reading the header is cheaper than the page fault of an access
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
    """Return a writable view of a segment, for libraries that do not support read-only memory.

    It is a second mapping, private and copy-on-write: reading copies nothing, a written page becomes private
    memory, and neither the segment nor any other view changes.  If the kernel refuses the mapping (data
    limit, ``ulimit -d``), or the segment has no name any more, the result is a copy.

    Parameters
    ----------
    segment
        The attached segment; stays attached as long as the result's arrays.
    name, offset, shm_dir
        As passed to `attach`; a retired segment is found, too.

    Raises
    ------
    LimitReached
        A copy is needed, and there is not enough memory.
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
    """Map a file privately; return None if it is not the segment's own file."""
    first = segment.raw
    end = offset + len(first)
    head = min(len(first), PAGE_BYTES)
    if os.fstat(fd).st_size < end or os.pread(fd, head, offset) != first[:head].tobytes():
        return None
    return _bytes_of(map_file(fd, end, private=True), offset, end, beside=first)

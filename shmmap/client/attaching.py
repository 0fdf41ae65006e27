# SPDX-License-Identifier: Apache-2.0
"""Handles to cells: each segment is mapped once in a client, and unmapped where no thread is disturbed.

What this process sees of the daemon's segments shows in the one that every daemon has, its statistics.

Cells and views end wherever the last reference to them is dropped, in any thread and in the middle of
anything.  What happens then is built in, appending to a deque or putting into a `queue.SimpleQueue`: it takes
no lock, and no signal handler runs in it, whose exception Python would have to ignore.
"""

from __future__ import annotations

import contextlib
import os
import warnings
import weakref
from collections import deque
from queue import Empty, SimpleQueue

from shmmap.client.cell import Access, Cell
from shmmap.errors import SegmentError, ShmmapWarning
from shmmap.protocol.messages import Handle
from shmmap.segment.attach import Owned, attach

__all__ = ["Attacher", "check_visible", "owner_of_segments"]


class _Attached(weakref.ref[Cell]):
    """A cell as long as others have it, and what it is found by."""

    __slots__ = ("key",)

    key: tuple[int, str]


class _Mapped(weakref.ref[Owned]):
    """Mapped memory, whose version is known also when it is mapped no more."""

    __slots__ = ("before", "version")

    before: _Mapped | None
    version: int


class Attacher:
    """Attaches handles; not thread-safe, but cells may end in any thread."""

    def __init__(self) -> None:
        self._cells: dict[tuple[int, str], _Attached] = {}
        self._dropped: deque[weakref.ref[Cell]] = deque()
        self._named_outside: set[str] = set()
        self._mapped: dict[int, _Mapped] = {}  # the last one of each version, which knows the one before
        self._ended: deque[_Mapped] = deque()
        self._unmapped: list[int] = []
        self._sinks: list[SimpleQueue[Owned | None]] = []

    def attach(
        self, handle: Handle, cell_id: str, segment: str, access: Access, *, populate: bool = False
    ) -> Cell:
        """Return the cell of a handle; one that is attached already is shared.

        Parameters
        ----------
        handle, cell_id, segment
            The handle, and what it names, whole.
        access
            Where the segments are, and whose.
        populate
            Let the kernel map every page now.

        Raises
        ------
        StaleHandle, SegmentCorrupt, SegmentError, LimitReached
            As `shmmap.segment.attach.attach`.

        Warns
        -----
        ShmmapWarning
            Points of the cell lie outside its box; once a cell.
        """
        key = (handle.version, handle.layer)
        known = self._cells.get(key)
        cell = known() if known is not None else None
        if cell is not None:
            cell.stale = handle.stale
            return cell
        attached = attach(
            segment,
            offset=handle.offset,
            nbytes=handle.bytes,
            shm_dir=access.shm_dir,
            slot=access.slot,
            owner=access.owner,
            populate=populate,
            sinks=self._sinks,
            on_mapped=lambda memory: self._note(memory, handle.version),
        )
        cell = Cell(cell_id, segment, handle, attached, access)
        found = _Attached(cell, self._dropped.append)
        found.key = key
        self._forget_dropped()
        self._cells[key] = found
        if (outside := attached.outside_points) and cell_id not in self._named_outside:
            self._named_outside.add(cell_id)
            warnings.warn(
                f"{cell.name}: {outside} of the cell's points lie outside its box {cell.box}:"
                " was the file moved, and the map's metadata not?",
                ShmmapWarning,
                stacklevel=2,
            )
        return cell

    def _forget_dropped(self) -> None:
        while self._dropped:
            gone = self._dropped[0]  # it stays until all is done: an exception may come anywhere
            if isinstance(gone, _Attached) and self._cells.get(gone.key) is gone:
                del self._cells[gone.key]
            self._dropped.popleft()

    def _note(self, memory: Owned, version: int) -> None:
        """Memory is mapped for a version; when and wherever it is unmapped, that is noted by itself."""
        mapped = _Mapped(memory, self._ended.append)
        mapped.version = version
        mapped.before = self._mapped.get(version)
        self._mapped[version] = mapped

    @property
    def any_mapped(self) -> bool:
        """Whether this client still has anything mapped, as of the last `unmapped`."""
        return bool(self._mapped)

    def unmapped(self) -> list[int]:
        """Versions of which nothing is mapped any more; to be emptied when the daemon knows them."""
        while self._ended:
            version = self._ended[0].version  # it stays until all is done: an exception may come anywhere
            known = left = self._mapped.get(version)
            while left is not None and left() is None:
                left = left.before
            if left is not None:
                self._mapped[version] = left
            elif known is not None:
                self._unmapped.append(version)
                del self._mapped[version]
            self._ended.popleft()
        return self._unmapped

    # --- where memory goes when its last view is gone -----------------------------------------------

    def unmap_in(self, queue: SimpleQueue[Owned | None]) -> None:
        """Hand memory from now on to a queue, whose thread unmaps it, instead of unmapping it on the spot."""
        self._sinks.append(queue)

    def stop_unmapping_in(self, queue: SimpleQueue[Owned | None]) -> None:
        """End `unmap_in`: the queue's thread ended."""
        if queue in self._sinks:
            self._sinks.remove(queue)
        with contextlib.suppress(Empty):
            while True:
                queue.get_nowait()

    def restart_in_child(self) -> None:
        """After a fork: threads stayed in the parent, and so did the session of what is unmapped here."""
        self._ended = deque()
        self._sinks.clear()


# --- the daemon's segments, as this process sees them ---------------------------------------------


def owner_of_segments(shm_dir: str, segment_prefix: str) -> int | None:
    """User whose segments they are, as this process sees it; None where it sees none."""
    try:
        return os.lstat(_statistics_path(shm_dir, segment_prefix)).st_uid
    except OSError:
        return None


def check_visible(shm_dir: str, segment_prefix: str) -> None:
    """Refuse a directory without the daemon's statistics: in a container it may be another one.

    Raises
    ------
    SegmentError
        The directory, as this process sees it, is not the daemon's.
    """
    if owner_of_segments(shm_dir, segment_prefix) is None:
        raise SegmentError(
            f"the daemon's segments are not in {shm_dir}, as this process sees it",
            hint="in a container mount the daemon's directory of segments, and name it with shm_dir or"
            " SHMMAP_SHM_DIR where its path differs",
        )


def _statistics_path(shm_dir: str, segment_prefix: str) -> str:
    """Path of the statistics segment of the daemon whose segments' names begin so."""
    return f"{shm_dir}/{segment_prefix.lstrip('/')}statistics"

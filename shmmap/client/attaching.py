# SPDX-License-Identifier: Apache-2.0
"""Turn handles into cells: map each segment once per client, and unmap it where that delays no thread.

Whether this process sees the daemon's segments is checked with the statistics segment, which every daemon
has.

Cells and views end where their last reference is dropped: in any thread, at any moment.  At that point only
built-in operations run: appending to a deque, or putting into a `queue.SimpleQueue`.  They take no lock, and
no signal handler can run in them and raise an exception that Python would have to ignore.
"""

from __future__ import annotations

import contextlib
import os
import weakref
from collections import deque
from queue import Empty, SimpleQueue

from shmmap.client.cell import Access, Cell
from shmmap.errors import SegmentError, warn_program
from shmmap.protocol.messages import Handle
from shmmap.segment.attach import Owned, attach


class _Attached(weakref.ref[Cell]):
    """Weak reference to an attached cell, and the key under which it is found."""

    __slots__ = ("key",)

    key: tuple[int, str]


class _Mapped(weakref.ref[Owned]):
    """Weak reference to mapped memory, which keeps the version after the memory is unmapped."""

    __slots__ = ("before", "version")

    before: _Mapped | None
    version: int


class Attacher:
    """Attaches handles; not thread-safe, but cells may end in any thread."""

    def __init__(self) -> None:
        self._cells: dict[tuple[int, str], _Attached] = {}
        self._dropped: deque[weakref.ref[Cell]] = deque()
        self._named_outside: set[str] = set()
        self._mapped: dict[int, _Mapped] = {}  # newest mapping per version, linked to the previous one
        self._ended: deque[_Mapped] = deque()
        self._unmapped: list[int] = []
        self._sinks: list[SimpleQueue[Owned | None]] = []

    def attached(self, handle: Handle) -> Cell | None:
        """Return the cell of a handle if it is attached already."""
        known = self._cells.get((handle.version, handle.layer))
        cell = known() if known is not None else None
        if cell is not None:
            cell.stale = handle.stale
        return cell

    def attach(
        self, handle: Handle, cell_id: str, segment: str, access: Access, *, populate: bool = False
    ) -> Cell:
        """Return the cell of a handle that is not `attached` yet.

        Parameters
        ----------
        handle, cell_id, segment
            The handle, and the full cell id and segment name that it abbreviates.
        access
            Directory and owner of the segments.
        populate
            Map every page now, not at first access.

        Raises
        ------
        StaleHandle, SegmentCorrupt, SegmentError, LimitReached
            As `shmmap.segment.attach.attach`.

        Warns
        -----
        ShmmapWarning
            Points of the cell lie outside its box; issued once per cell.
        """
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
        found.key = handle.version, handle.layer
        self._forget_dropped()
        self._cells[found.key] = found
        if (outside := attached.outside_points) and cell_id not in self._named_outside:
            self._named_outside.add(cell_id)
            warn_program(
                f"{cell.name}: {outside} of the cell's points lie outside its box {cell.box}:"
                " was the file moved, and the map's metadata not?"
            )
        return cell

    def _forget_dropped(self) -> None:
        while self._dropped:
            gone = self._dropped[0]  # removed only after the work: an exception may interrupt at any point
            if isinstance(gone, _Attached) and self._cells.get(gone.key) is gone:
                del self._cells[gone.key]
            self._dropped.popleft()

    def _note(self, memory: Owned, version: int) -> None:
        """Record that memory is mapped for a version; a weak reference records when it is unmapped."""
        mapped = _Mapped(memory, self._ended.append)
        mapped.version = version
        mapped.before = self._mapped.get(version)
        self._mapped[version] = mapped

    @property
    def any_mapped(self) -> bool:
        """Whether this client still maps any memory, as of the last call of `unmapped`."""
        return bool(self._mapped)

    @property
    def has_unmapped(self) -> bool:
        """Whether `unmapped` may return any version."""
        return bool(self._ended or self._unmapped)

    def unmapped(self) -> list[int]:
        """Versions that this client no longer maps; the caller clears the list when the daemon has them."""
        while self._ended:
            version = self._ended[0].version  # removed only afterwards: an exception may interrupt here
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

    # --- unmapping memory whose last view is gone ----------------------------------------------------------

    def unmap_in(self, queue: SimpleQueue[Owned | None]) -> None:
        """From now on put unused memory into a queue, whose thread unmaps it, instead of unmapping here."""
        self._sinks.append(queue)

    def stop_unmapping_in(self, queue: SimpleQueue[Owned | None]) -> None:
        """Undo `unmap_in`: the queue's thread has ended."""
        if queue in self._sinks:
            self._sinks.remove(queue)
        with contextlib.suppress(Empty):
            while True:
                queue.get_nowait()

    def restart_in_child(self) -> None:
        """Reset the state after a fork: unmapping threads and the session stay in the parent."""
        self._ended = deque()
        self._sinks.clear()


# --- the daemon's segments, as this process sees them ---------------------------------------------


def owner_of_segments(shm_dir: str, segment_prefix: str) -> int | None:
    """Return the user id that owns the segments, as this process sees it; None if it sees no segment."""
    try:
        return os.lstat(f"{shm_dir}/{segment_prefix.lstrip('/')}statistics").st_uid
    except OSError:
        return None


def check_visible(shm_dir: str, segment_prefix: str) -> None:
    """Refuse a directory without the daemon's statistics segment: a container may have another one there.

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

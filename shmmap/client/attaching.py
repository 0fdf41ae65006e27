# SPDX-License-Identifier: Apache-2.0
"""Handles to cells: each segment is mapped once in a client, and unmapped where nobody is disturbed."""

from __future__ import annotations

import contextlib
import os
import warnings
import weakref
from collections import deque
from queue import Empty, SimpleQueue
from typing import Final
from weakref import WeakValueDictionary

from shmmap.client.cell import Cell
from shmmap.errors import ShmmapWarning
from shmmap.protocol.messages import Handle
from shmmap.segment.attach import attach
from shmmap.segment.owned import Owned

__all__ = ["Attacher", "Unmapper"]


class Unmapper:
    """Where mapped memory goes when its last view is gone: nowhere, which unmaps it, or to a thread.

    Views end wherever the last reference to them is dropped, in any thread and in the middle of
    anything, so nothing here takes a lock; `queue.SimpleQueue` is made for that.
    """

    def __init__(self) -> None:
        self._pid = os.getpid()
        self._sinks: tuple[SimpleQueue[Owned | None], ...] = ()
        self._getpid: Final = os.getpid  # kept here, for memory that ends while the interpreter shuts down

    def __call__(self, memory: Owned) -> None:
        """Take memory that nobody looks at any more."""
        sinks = self._sinks
        if sinks and self._getpid() == self._pid:
            sinks[0].put(memory)
            if sinks[0] not in self._sinks:  # its thread ended meanwhile
                _drain(sinks[0])

    def defer_to(self, queue: SimpleQueue[Owned | None]) -> None:
        """From now on hand memory to a queue, whose thread unmaps it."""
        self._sinks = (*self._sinks, queue)

    def stop_deferring(self, queue: SimpleQueue[Owned | None]) -> None:
        """End `defer_to`: the queue's thread ended."""
        self._sinks = tuple(other for other in self._sinks if other is not queue)
        _drain(queue)

    def restart_in_child(self) -> None:
        """After a fork: the threads that memory was handed to stayed in the parent."""
        self._pid = os.getpid()
        self._sinks = ()


def _drain(queue: SimpleQueue[Owned | None]) -> None:
    with contextlib.suppress(Empty):
        while True:
            queue.get_nowait()


class _Mapped(weakref.ref[Owned]):
    """Mapped memory, whose version is known also when it is mapped no more."""

    __slots__ = ("before", "version")

    before: _Mapped | None
    version: int


class Attacher:
    """Attaches handles; not thread-safe, but cells may end in any thread.

    Attributes
    ----------
    unmapper : Unmapper
        Where the mappings of its cells go.
    """

    def __init__(self) -> None:
        self.unmapper = Unmapper()
        self._cells: WeakValueDictionary[tuple[int, str], Cell] = WeakValueDictionary()
        self._named_outside: set[str] = set()
        self._mapped: dict[int, _Mapped] = {}  # the last one of each version, which knows the one before
        self._ended: deque[_Mapped] = deque()
        self._unmapped: list[int] = []

    def attach(
        self,
        handle: Handle,
        cell_id: str,
        segment: str,
        *,
        shm_dir: str,
        slot: int,
        owner: int | None = None,
        populate: bool = False,
    ) -> Cell:
        """Return the cell of a handle; one that is attached already is shared.

        Parameters are those of `shmmap.segment.attach.attach`.

        Raises
        ------
        StaleHandle, SegmentCorrupt, SegmentError
            As `shmmap.segment.attach.attach`.

        Warns
        -----
        ShmmapWarning
            Points of the cell lie outside its box; once a cell.
        """
        key = (handle.version, handle.layer)
        cell = self._cells.get(key)
        if cell is not None:
            cell.stale = handle.stale
            return cell
        attached = attach(
            segment,
            offset=handle.offset,
            nbytes=handle.bytes,
            shm_dir=shm_dir,
            slot=slot,
            owner=owner,
            populate=populate,
            on_unmap=self.unmapper,
            on_mapped=lambda memory: self._note(memory, handle.version),
        )
        cell = self._cells[key] = Cell(cell_id, segment, handle, attached)
        if (outside := attached.outside_points) and cell_id not in self._named_outside:
            self._named_outside.add(cell_id)
            warnings.warn(
                f"{cell.name}: {outside} of the cell's points lie outside its box {cell.box}:"
                " was the file moved, and the map's metadata not?",
                ShmmapWarning,
                stacklevel=2,
            )
        return cell

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
        """Versions of which nothing is mapped any more; to be emptied by whoever has told the daemon."""
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

    def restart_in_child(self) -> None:
        """After a fork: what is unmapped here, the parent's session still has."""
        self._ended = deque()
        self.unmapper.restart_in_child()

# SPDX-License-Identifier: Apache-2.0
"""Handles to cells: each segment is mapped once in a client, and unmapped where nobody is disturbed."""

from __future__ import annotations

import contextlib
import os
from functools import partial
from queue import Empty, SimpleQueue
from typing import Final, TypeAlias
from weakref import WeakValueDictionary

from shmmap.client.cell import Cell
from shmmap.protocol.messages import Handle
from shmmap.segment.attach import attach, unmap

__all__ = ["Attacher", "Mapping", "Unmapper"]

Mapping: TypeAlias = tuple[int, int, int]
"""Version of the cell it was, address, bytes."""


class Unmapper:
    """Where mappings go when their last view is gone: to the kernel at once, or to a thread.

    Views end wherever the last reference to them is dropped, in any thread and in the middle of
    anything, so nothing here takes a lock; `queue.SimpleQueue` is made for that.

    Attributes
    ----------
    unmapped : SimpleQueue of int
        Versions whose mappings are gone, not yet told to the daemon.
    """

    def __init__(self) -> None:
        self._pid = os.getpid()
        self._sinks: tuple[SimpleQueue[Mapping | None], ...] = ()
        self.unmapped: SimpleQueue[int] = SimpleQueue()
        # kept here, for mappings that end while the interpreter shuts down
        self._getpid: Final = os.getpid
        self._unmap: Final = unmap

    def __call__(self, version: int, address: int, nbytes: int) -> None:
        """Take a mapping that nobody looks at any more."""
        sinks = self._sinks
        if sinks and self._getpid() == self._pid:
            sinks[0].put((version, address, nbytes))
            if sinks[0] not in self._sinks:  # its thread ended meanwhile
                self._drain(sinks[0])
        else:
            self.finish((version, address, nbytes))

    def finish(self, mapping: Mapping) -> None:
        """Unmap now."""
        version, address, nbytes = mapping
        self._unmap(address, nbytes)
        self.unmapped.put(version)

    def defer_to(self, queue: SimpleQueue[Mapping | None]) -> None:
        """From now on hand mappings to a queue, whose thread calls `finish` with each."""
        self._sinks = (*self._sinks, queue)

    def stop_deferring(self, queue: SimpleQueue[Mapping | None]) -> None:
        """End `defer_to`: the queue's thread ended."""
        self._sinks = tuple(other for other in self._sinks if other is not queue)
        self._drain(queue)

    def _drain(self, queue: SimpleQueue[Mapping | None]) -> None:
        with contextlib.suppress(Empty):
            while True:
                mapping = queue.get_nowait()
                if mapping is not None:
                    self.finish(mapping)

    def restart_in_child(self) -> None:
        """After a fork: the threads that mappings were handed to stayed in the parent."""
        self._pid = os.getpid()
        self._sinks = ()
        self.unmapped = SimpleQueue()


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
        self._mapped: dict[int, int] = {}

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
            on_unmap=partial(self.unmapper, handle.version),
        )
        self._mapped[handle.version] = self._mapped.get(handle.version, 0) + 1
        cell = self._cells[key] = Cell(cell_id, segment, handle, attached)
        return cell

    @property
    def any_mapped(self) -> bool:
        """Whether this client still has anything mapped, as far as `take_unmapped` was told."""
        return bool(self._mapped)

    def take_unmapped(self) -> list[int]:
        """Versions of which nothing is mapped any more, each told once."""
        if self.unmapper.unmapped.empty():
            return []
        gone: list[int] = []
        with contextlib.suppress(Empty):
            while True:
                version = self.unmapper.unmapped.get_nowait()
                left = self._mapped.get(version, 0) - 1
                if left > 0:
                    self._mapped[version] = left
                elif self._mapped.pop(version, None) is not None:
                    gone.append(version)
        return gone

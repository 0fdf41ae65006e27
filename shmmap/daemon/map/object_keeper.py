# SPDX-License-Identifier: Apache-2.0
"""Fetches objects of a published map onto the disk before any loader needs them, in a few threads.

Objects are fetched and verified against their hash as loaders do it; they are not unpacked.
"""

from __future__ import annotations

import contextlib
import os
import queue
import threading
from collections import deque
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

from shmmap.errors import Offline, ShmmapError
from shmmap.logfmt import log
from shmmap.origin.remote.object_tier import KeptObjects, ObjectCounts, ObjectTier
from shmmap.origin.remote.published_object import ObjectName
from shmmap.origin.remote.transport import reporting_bytes

THREADS: Final = 8


class KeptCell(NamedTuple):
    """The layer of a cell that objects belong to; the cell is given by its index in a version of the map."""

    map_version: int
    cell: int
    layer: str


class Kept(NamedTuple):
    """Result of keeping a cell's objects.

    Attributes
    ----------
    is_here
        The objects are on the disk.
    has_no_room
        The objects were fetched, but the disk has no room for them.
    received
        Bytes that came from the store.
    """

    key: KeptCell
    is_here: bool
    has_no_room: bool = False
    received: int = 0


class ObjectKeeper:
    """Fetches objects into the disk tier only.

    Parameters
    ----------
    failed
        Called, in a thread, when the store could not be reached.
    arrived
        Called, in a thread, with the number of bytes of each piece that comes from the store.

    Attributes
    ----------
    fd
        Readable when `take` has results.
    """

    def __init__(
        self,
        objects: KeptObjects,
        tier: ObjectTier,
        failed: Callable[[], None],
        arrived: Callable[[int], None] = lambda _nbytes: None,
    ) -> None:
        self.fd = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._objects, self._tier, self._failed, self._arrived = objects, tier, failed, arrived
        self._wanted: queue.SimpleQueue[tuple[KeptCell, Sequence[ObjectName]] | None] = queue.SimpleQueue()
        self._done: deque[Kept] = deque()
        self._threads: list[threading.Thread] = []
        self._under_way = 0

    @property
    def counts(self) -> ObjectCounts:
        """Counts of reads so far."""
        return self._objects.counts

    @property
    def free_places(self) -> int:
        """Number of further cells that could be begun now."""
        return THREADS - self._under_way

    def keep(self, key: KeptCell, names: Sequence[ObjectName]) -> None:
        """Fetch objects onto the disk."""
        self._under_way += 1
        if len(self._threads) < min(self._under_way, THREADS):
            thread = threading.Thread(target=self._run, name="keep", daemon=True)
            with contextlib.suppress(RuntimeError):  # the system allows no more threads
                thread.start()
                self._threads.append(thread)
        if self._threads:
            self._wanted.put((key, names))
        else:
            self._finish(Kept(key, False))

    def take(self) -> list[Kept]:
        """Return the results since the last call."""
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self.fd)
        found = [self._done.popleft() for _ in range(len(self._done))]
        self._under_way -= len(found)
        return found

    def _run(self) -> None:
        while (wanted := self._wanted.get()) is not None:
            received = 0

            def arrived(nbytes: int) -> None:
                nonlocal received
                received += nbytes
                self._arrived(nbytes)

            with reporting_bytes(arrived):
                kept = self._keep(*wanted)
            self._finish(kept._replace(received=received))

    def _finish(self, kept: Kept) -> None:
        self._done.append(kept)
        os.eventfd_write(self.fd, 1)

    def _keep(self, key: KeptCell, names: Sequence[ObjectName]) -> Kept:
        try:
            for name in names:
                if self._tier.has(name.sha256, name.size):
                    continue
                self._objects.read(name.sha256, name.size)
                if not self._tier.has(name.sha256, name.size):
                    return Kept(key, False, has_no_room=True)
        except Offline:
            self._failed()
            return Kept(key, False)
        except ShmmapError:  # a loader that needs the object reports the error with the cell's name
            return Kept(key, False)
        except BaseException:  # noqa: BLE001  also panics: else the cell would stay under way
            log.exception("an object cannot be kept on disk ahead", cause="a defect in shmmap")
            return Kept(key, False)
        return Kept(key, True)

    def close(self) -> list[threading.Thread]:
        """Have the threads end, and return them; some may still wait for the store."""
        with contextlib.suppress(queue.Empty):
            while True:
                self._wanted.get_nowait()
        for _ in self._threads:
            self._wanted.put(None)
        return self._threads

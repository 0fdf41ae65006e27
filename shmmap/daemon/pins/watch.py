# SPDX-License-Identifier: Apache-2.0
"""Queries the kernel for the processes that use a segment, and gets reports when a process closes one.

The daemon keeps a retired segment open while a client maps it.  The kernel reports when any process closes or
unmaps the segment, so no timer is needed.  Queries use the descriptor that the daemon keeps open, which the
kernel does not count: a query opens and closes nothing, and causes no report itself.
"""

from __future__ import annotations

import contextlib
import os
import resource
from collections.abc import Iterator
from typing import Final

from shmmap.daemon.host.inotify import CLOSED, ENDED, OVERFLOW, Inotify
from shmmap.daemon.pins.probe import PinSource
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.pins import holders, in_use

KEPT_OPEN: Final = 1024
"""Limit of retired segments that are kept open; others are queried periodically."""
KEPT_SHARE: Final = 8
"""Limit as a fraction (1/8) of this process's descriptors: clients need them more."""


class PinWatch:
    """Use of the files of one directory, as the kernel reports it.

    Parameters
    ----------
    source
        The source to query; for `PinSource.SESSIONS` the caller asks the sessions.
    events
        Whether the kernel is to report closes.

    Attributes
    ----------
    fd
        Readable when `closed` has something to report; -1 if closes are not reported.
    """

    def __init__(
        self, directory: ShmDirectory, source: PinSource = PinSource.LEASES, *, events: bool = False
    ) -> None:
        self.source = source
        self._directory = directory
        self._kept: dict[str, tuple[int, int]] = {}
        self._names: dict[int, str] = {}
        self._once: dict[str, int] = {}
        self._max_kept = min(KEPT_OPEN, resource.getrlimit(resource.RLIMIT_NOFILE)[0] // KEPT_SHARE)
        self._inotify: Inotify | None = None
        if events:
            with contextlib.suppress(OSError):
                self._inotify = Inotify()
        self.fd = self._inotify.fd if self._inotify is not None else -1

    def close(self) -> None:
        """Close everything."""
        for name in list(self._kept):
            self.release(name)
        if self._inotify is not None:
            self._inotify.close()
            self._inotify, self.fd = None, -1

    @contextlib.contextmanager
    def opened(self, name: str) -> Iterator[int]:
        """Yield a descriptor of a segment, kept or temporary; raise OSError as opening does."""
        kept = self._kept.get(name)
        if kept is not None:
            yield kept[0]
            return
        once = self._once.pop(name, -1)
        if once >= 0 and self._inotify is not None:  # else closing the temporary descriptor would be reported
            self._inotify.remove(once)
        with self._directory.opened(name) as fd:
            yield fd
        if once >= 0:
            self.watch_next_close(name)

    def is_used_elsewhere(self, fd: int) -> bool:
        """Whether another process uses an open segment; False if the kernel does not show it."""
        if self.source is PinSource.LEASES:
            return in_use(fd)
        return self.source is PinSource.LOCKS and bool(holders(fd, limit=1))

    def is_used(self, name: str) -> bool | None:
        """Whether a process uses a segment; None if the segment's name is gone."""
        try:
            with self.opened(name) as fd:
                return self.is_used_elsewhere(fd)
        except FileNotFoundError:
            return None
        except OSError:
            return True  # e.g. out of descriptors: a segment not queried must not count as free

    def keep(self, name: str) -> bool:
        """Keep a retired segment open and have its closes reported; return False if that fails."""
        if self._inotify is None or len(self._kept) >= self._max_kept:
            return False
        try:
            fd = self._directory.open(name)
        except OSError:
            return False
        try:
            watch = self._inotify.add(f"/proc/self/fd/{fd}", CLOSED)
        except OSError:
            os.close(fd)
            return False
        self._once.pop(self._names.get(watch, ""), None)  # the one-time watch is now permanent
        self._kept[name] = fd, watch
        self._names[watch] = name
        return True

    def keeps(self, name: str) -> bool:
        """Whether closes of this segment are being reported."""
        return name in self._kept

    def release(self, name: str) -> None:
        """End `keep`."""
        kept = self._kept.pop(name, None)
        if kept is not None and self._inotify is not None:
            fd, watch = kept
            self._inotify.remove(watch)
            self._names.pop(watch, None)
            os.close(fd)

    def watch_next_close(self, name: str) -> bool:
        """Watch for the next close of a segment in service; return False if that is impossible."""
        if self._inotify is None:
            return False
        try:
            watch = self._inotify.add(self._directory.path + name, CLOSED, once=True)
        except OSError:
            return False
        self._names[watch], self._once[name] = name, watch
        return True

    def closed(self) -> set[str] | None:
        """Return the names closed since the last call; None if the kernel lost reports of some."""
        if self._inotify is None:
            return set()
        names: set[str] = set()
        for event in self._inotify.read():
            if event.mask & OVERFLOW:
                return None
            name = self._names.get(event.watch)
            if name is None:
                continue
            if event.mask & ENDED:  # it was reported, or ended by our own query; reports before that count
                del self._names[event.watch]
                if self._once.get(name) == event.watch:
                    del self._once[name]
            else:
                names.add(name)
        return names

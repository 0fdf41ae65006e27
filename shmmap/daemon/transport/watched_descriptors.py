# SPDX-License-Identifier: Apache-2.0
"""Descriptors that the serving loop polls: clients' connections, loaders, the kernel."""

from __future__ import annotations

import select
from collections.abc import Callable
from typing import Final

__all__ = ["WatchedDescriptors"]

DESCRIPTORS_PER_TURN: Final = 16
"""The kernel begins with those that were not looked at last time."""


class WatchedDescriptors:
    """Callbacks for descriptors that are readable.

    ``kinds`` are the kinds of turn that they make, of `shmmap.statistics.counters.TURN_KINDS`.
    """

    def __init__(self) -> None:
        self._epoll = select.epoll()
        self.callbacks: dict[int, Callable[[], None]] = {}
        self.kinds: dict[int, str] = {}
        self._again: list[int] = []

    def watch(self, fd: int, callback: Callable[[], None], kind: str = "clients") -> None:
        """Call ``callback`` from the loop whenever ``fd`` is readable, or its other end is closed."""
        self.callbacks[fd], self.kinds[fd] = callback, kind
        self._epoll.register(fd, select.EPOLLIN)

    def watch_for(self, fd: int, *, reading: bool, writing: bool) -> None:
        """Call a watched descriptor's callback when it can be read or written; always when it is closed."""
        self._epoll.modify(fd, reading * select.EPOLLIN | writing * select.EPOLLOUT)

    def call_again(self, fd: int) -> None:
        """Call its callback in the next turn, whatever the kernel says."""
        self._again.append(fd)

    def unwatch(self, fd: int) -> None:
        """Stop watching; before the descriptor is closed."""
        callback = self.callbacks.pop(fd, None)  # it may hold the last reference to the descriptor's owner
        if callback is not None:
            del self.kinds[fd]
            self._epoll.unregister(fd)

    def poll(self, timeout_s: float) -> list[int]:
        """Wait until descriptors are ready, at most this long, and return them."""
        again, self._again = self._again, []
        ready = self._epoll.poll(0 if again else timeout_s, DESCRIPTORS_PER_TURN)
        return [*again, *(fd for fd, _events in ready)]

    def close(self) -> None:
        """Stop polling, after everything watched is gone."""
        self._epoll.close()

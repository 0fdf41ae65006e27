# SPDX-License-Identifier: Apache-2.0
"""Descriptors that the serving loop hears besides its socket: loaders, clients' processes, the kernel."""

from __future__ import annotations

import select
from collections.abc import Callable

__all__ = ["WatchedDescriptors"]


class WatchedDescriptors:
    """Who is called when which descriptor is readable.

    Attributes
    ----------
    fd : int
        Readable when one of them is.
    poll : callable
        Gives those that are (`select.epoll.poll`).
    callbacks : dict
        What to call, by descriptor.
    """

    def __init__(self) -> None:
        self._epoll = select.epoll()
        self.fd = self._epoll.fileno()
        self.poll = self._epoll.poll
        self.callbacks: dict[int, Callable[[], None]] = {}

    def watch(self, fd: int, callback: Callable[[], None]) -> None:
        """Call ``callback`` from the loop whenever ``fd`` is readable."""
        self.callbacks[fd] = callback
        self._epoll.register(fd, select.EPOLLIN)

    def unwatch(self, fd: int) -> None:
        """Stop watching; before the descriptor is closed."""
        if self.callbacks.pop(fd, None) is not None:
            self._epoll.unregister(fd)

    def close(self) -> None:
        """Watch nothing any more; after everything watched is gone."""
        self._epoll.close()

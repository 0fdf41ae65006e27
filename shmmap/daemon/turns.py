# SPDX-License-Identifier: Apache-2.0
"""Turns of the serving loop: the descriptors that begin one, and how long each part of it may take.

A *turn* lasts from one poll to the next.  Requests come first, in a *burst* of `BURST_S`.  Then follows a
*round* of all other work, in *steps*: a turn begins no further step after `TURN_NS`, and the round goes on in
the next one.  A step of work over many things, a generator or a `Walk`, ends after `STEP_S`.
"""

from __future__ import annotations

import select
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Final, Generic, TypeVar

TURN_NS: Final = 50_000
"""Processor time after which a turn begins no step of a round."""
STEP_S: Final = 0.0005
"""Longest time of a step of work over many things, but for the last of them."""
BURST_S: Final = 0.002
"""Longest time of requests before a round of all other work, and of handing out loads in a round."""
LONG_TURN_NS: Final = 10_000_000
"""Processor time above which a turn is reported as an event."""
DESCRIPTORS_PER_TURN: Final = 16
"""Descriptors returned per poll, and called again; the kernel begins with those not returned last time."""


class WatchedDescriptors:
    """Callbacks of descriptors that are readable.

    ``kinds`` are their kinds of turn, see `shmmap.statistics.counters.TURN_KINDS`; ``wakes`` counts the polls
    in which one was ready.
    """

    def __init__(self) -> None:
        self._epoll = select.epoll()
        self.callbacks: dict[int, Callable[[], None]] = {}
        self.kinds: dict[int, str] = {}
        self._again: list[int] = []
        self.wakes = 0

    def watch(self, fd: int, callback: Callable[[], None], kind: str = "clients") -> None:
        """Call ``callback`` from the loop whenever ``fd`` is readable, or its peer has closed."""
        self.callbacks[fd], self.kinds[fd] = callback, kind
        self._epoll.register(fd, select.EPOLLIN)

    def watch_for(self, fd: int, *, reading: bool, writing: bool) -> None:
        """Call a watched descriptor's callback when it is readable or writable; always when it is closed."""
        self._epoll.modify(fd, reading * select.EPOLLIN | writing * select.EPOLLOUT)

    def call_again(self, fd: int) -> None:
        """Call a descriptor's callback in one of the next turns, whether it is ready or not."""
        self._again.append(fd)

    def unwatch(self, fd: int) -> None:
        """Stop watching a descriptor; call this before closing it."""
        callback = self.callbacks.pop(fd, None)  # it may hold the last reference to the descriptor's owner
        if callback is not None:
            del self.kinds[fd]
            self._epoll.unregister(fd)

    def poll(self, timeout_s: float) -> list[int]:
        """Wait until descriptors are ready, at most ``timeout_s``, and return them."""
        again, self._again = self._again[:DESCRIPTORS_PER_TURN], self._again[DESCRIPTORS_PER_TURN:]
        ready = self._epoll.poll(0 if again else timeout_s, DESCRIPTORS_PER_TURN)
        self.wakes += bool(again or ready)
        return [*again, *(fd for fd, _events in ready)]

    def close(self) -> None:
        """Stop polling, after all watched descriptors have been removed."""
        self._epoll.close()


Item = TypeVar("Item")


class Walk(Generic[Item]):
    """A walk over many items that takes several steps; without items it is done.

    Attributes
    ----------
    is_done : bool
        Whether the walk has reached its end.
    """

    __slots__ = ("_items", "is_done")

    def __init__(self, items: Iterable[Item] | None = None) -> None:
        self._items = iter(items or ())
        self.is_done = items is None

    def for_a_step(self) -> Iterator[Item]:
        """Yield items until the step's time is used up, at least one."""
        end_s = time.monotonic() + STEP_S
        for item in self._items:
            yield item
            if time.monotonic() >= end_s:
                return
        self.is_done = True

# SPDX-License-Identifier: Apache-2.0
"""Turns of the serving loop: descriptors that begin a turn, and time limits of long work in it."""

from __future__ import annotations

import select
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Final, Generic, TypeVar

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


TURN_S: Final = 0.0005
"""Time after which a walk over many things is left to the next turn."""

Item = TypeVar("Item")


class Pace:
    """Time limit of an operator's or a statistics request in its current turn."""

    __slots__ = ("_end_s",)

    def __init__(self) -> None:
        self._end_s = time.monotonic() + TURN_S

    def pause(self) -> Iterator[None]:
        """End the turn if its time is used up, and begin the next one."""
        if time.monotonic() >= self._end_s:
            yield
            self._end_s = time.monotonic() + TURN_S


class Walk(Generic[Item]):
    """A walk over many items that takes several turns; without items it is done.

    Attributes
    ----------
    is_done : bool
        Whether the walk has reached its end.
    """

    __slots__ = ("_items", "is_done")

    def __init__(self, items: Iterable[Item] | None = None) -> None:
        self._items = iter(items or ())
        self.is_done = items is None

    def for_a_turn(self) -> Iterator[Item]:
        """Yield items until the turn's time is used up, at least one."""
        end_s = time.monotonic() + TURN_S
        for item in self._items:
            yield item
            if time.monotonic() >= end_s:
                return
        self.is_done = True

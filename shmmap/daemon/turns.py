# SPDX-License-Identifier: Apache-2.0
"""Turns of the serving loop: which descriptors begin one, and how long work on many things goes on in it."""

from __future__ import annotations

import select
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Final, Generic, TypeVar

__all__ = ["BATCH", "TURN_S", "Pace", "Walk", "WatchedDescriptors", "batched"]

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


TURN_S: Final = 0.0005
"""Time after which the rest is left to the next turn.  A request for some hundred cells needs less."""

BATCH: Final = 16
"""Things between two looks at the time, where each takes some microseconds."""

Item = TypeVar("Item")


def batched(items: Sequence[Item]) -> Iterator[Sequence[Item]]:
    """Return batches of many things, to look at the time before each of them."""
    return (items[begin : begin + BATCH] for begin in range(0, len(items), BATCH))


class Pace:
    """The time that a generator has in its present turn."""

    __slots__ = ("_end_s",)

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """Begin a turn."""
        self._end_s = time.monotonic() + TURN_S

    @property
    def is_over(self) -> bool:
        """Whether the turn has used its time."""
        return time.monotonic() >= self._end_s

    def pause(self) -> Iterator[None]:
        """End the turn, if it has used its time, and begin the next one."""
        if self.is_over:
            yield
            self.begin()


class Walk(Generic[Item]):
    """A walk over many things that takes several turns; without any it is done.

    Attributes
    ----------
    is_done : bool
        Whether it has come to its end.
    """

    __slots__ = ("_items", "is_done")

    def __init__(self, items: Iterable[Item] | None = None) -> None:
        self._items = iter(items or ())
        self.is_done = items is None

    def for_a_turn(self) -> Iterator[Item]:
        """Go on until the turn's time is used: one item further at least."""
        end_s = time.monotonic() + TURN_S
        for item in self._items:
            yield item
            if time.monotonic() >= end_s:
                return
        self.is_done = True

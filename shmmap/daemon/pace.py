# SPDX-License-Identifier: Apache-2.0
"""How long work on many things goes on in one turn of the serving loop: one budget of time."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from typing import Final, Generic, TypeVar

__all__ = ["BATCH", "TURN_S", "Pace", "Walk", "batched"]

TURN_S: Final = 0.001
"""Time after which the rest is left to the next turn.  A request for some hundred cells needs less."""

BATCH: Final = 32
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

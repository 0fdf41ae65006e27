# SPDX-License-Identifier: Apache-2.0
"""Which load comes next: those who ask take turns, and of each one's loads the nearest comes first.

However many cells one process asks for, another one's cells do not wait for more than a fair share
of them.  Turns are by bytes, as `turns` has them by time.  What nobody waits for (checks of adopted
segments, pinned cells) comes when nothing else is queued.

Pure: a load is here from `push` to `discard`.
"""

from __future__ import annotations

import heapq
from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import Final, Generic, Protocol, TypeVar

__all__ = ["BACKGROUND", "LoadQueue"]

BACKGROUND: Final = 1e12
"""From this priority on a load is one that nobody waits for."""
LOAD_COST_BYTES: Final = 64 << 10
"""What a load costs besides its bytes: many tiny cells are work, too."""


class _Load(Protocol):
    """What the queue needs to know of a load."""

    estimate: int
    number: int


Queued = TypeVar("Queued", bound=_Load)


@dataclass(eq=False, slots=True)
class _Asker(Generic[Queued]):
    """One asker's loads by priority; ``clock`` is the bytes it has been given."""

    clock: int
    heap: list[tuple[float, int, Queued]] = field(default_factory=list)
    best: dict[int, float] = field(default_factory=dict)


class LoadQueue(Generic[Queued]):
    """Loads that wait for a worker or for room."""

    def __init__(self) -> None:
        self._loads: dict[int, Queued] = {}
        self._askers: dict[Hashable, _Asker[Queued]] = {}
        self._clock = 0
        self._chosen: Hashable = None

    def __len__(self) -> int:
        return len(self._loads)

    def count(self, asker: Hashable) -> int:
        """How many loads somebody asked for wait."""
        mine = self._askers.get(asker)
        return 0 if mine is None else sum(number in self._loads for number in mine.best)

    def push(self, load: Queued, priority: float, asker: Hashable) -> None:
        """Somebody wants this; asked for again, it is never moved back."""
        self._loads[load.number] = load
        mine = self._askers.get(asker)
        if mine is None:
            mine = self._askers[asker] = _Asker(self._clock)
        known = mine.best.get(load.number)
        if known is None or priority < known:
            mine.best[load.number] = priority
            heapq.heappush(mine.heap, (priority, load.number, load))

    def discard(self, load: Queued) -> None:
        """It does not wait any more."""
        self._loads.pop(load.number, None)

    def started(self, load: Queued) -> None:
        """It does not wait any more, and counts for whose turn it was."""
        self.discard(load)
        chosen = self._askers.get(self._chosen)
        if chosen is not None:
            chosen.clock += load.estimate + LOAD_COST_BYTES

    def next(self) -> Queued | None:
        """The load that comes next, or None."""
        found: tuple[bool, int, float, int] | None = None
        for asker, mine in list(self._askers.items()):
            self._clean(mine)
            if not mine.heap:
                del self._askers[asker]
                continue
            priority, number, _ = mine.heap[0]
            rank = (priority >= BACKGROUND, mine.clock, priority, number)
            if found is None or rank < found:
                found, self._chosen = rank, asker
        if found is None:
            return None
        chosen = self._askers[self._chosen]
        self._clock = max(self._clock, chosen.clock)
        return chosen.heap[0][2]

    def _clean(self, mine: _Asker[Queued]) -> None:
        """Drop what does not wait any more from the front, and from everywhere once it is most."""
        while mine.heap and mine.heap[0][1] not in self._loads:
            mine.best.pop(heapq.heappop(mine.heap)[1], None)
        if len(mine.heap) > 2 * len(self._loads) + 64:
            mine.best = {number: p for number, p in mine.best.items() if number in self._loads}
            mine.heap = [(p, number, self._loads[number]) for number, p in mine.best.items()]
            heapq.heapify(mine.heap)

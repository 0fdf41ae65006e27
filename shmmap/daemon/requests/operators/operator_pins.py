# SPDX-License-Identifier: Apache-2.0
"""Cells that an operator wants resident, asked for or not: they are loaded, and never make room.

A pin is on a cell and a layer, not on a version: a cell that changes is loaded anew, one that
cannot be loaded is tried again.  Pins end with `unpin` or with the daemon.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Final

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.loading.loads import BACKGROUND
from shmmap.daemon.loading.scheduler import Scheduler
from shmmap.daemon.records import Key
from shmmap.errors import OverBudget
from shmmap.layers.spec import canonical_layers
from shmmap.protocol import messages
from shmmap.protocol.messages import PinnedCell

__all__ = ["OperatorPins"]

LOOKS_AT_ONCE: Final = 64
"""Pins looked at per beat: about a fifth of a millisecond."""


class OperatorPins:
    """The pinned cells of one map.

    A pin counts in the ledger as one more request that waits for the cell: that is what keeps it out
    of the candidates for eviction.
    """

    def __init__(self, cache: CellCache, scheduler: Scheduler) -> None:
        self._cache = cache
        self._scheduler = scheduler
        self._keys: set[Key] = set()
        self._round: deque[Key] = deque()

    def __len__(self) -> int:
        return len(self._keys)

    def __contains__(self, key: Key) -> bool:
        return key in self._keys

    def layers_of(self, cell_id: str) -> tuple[str, ...]:
        """Layers in which a cell is pinned."""
        return tuple(sorted(key.layer for key in self._keys if key.cell_id == cell_id))

    def pin(self, message: messages.Pin, now_s: float) -> messages.Pinned:
        """Pin cells; without ids, say what is pinned.

        Raises
        ------
        OverBudget
            All pins together would take more than the budget.
        """
        wanted, unknown = self._keys_of(message.ids, canonical_layers(message.layers))
        total = sum(map(self._size, self._keys | wanted))
        budget = self._cache.ledger.budget_bytes
        if wanted and total + self._cache.ledger.overhead_bytes > budget:
            raise OverBudget(
                f"with these cells {total} bytes would be pinned; the budget is {budget} bytes",
                hint="unpin others, or serve with a larger --budget",
            )
        for key in wanted - self._keys:
            self._cache.ledger.need(key)
            self._keys.add(key)
            self._round.append(key)
        for key in wanted:
            self._keep(key, now_s)
        shown = wanted if message.ids else self._keys
        return self._answer(message.request, shown, unknown)

    def unpin(self, message: messages.Unpin) -> messages.Pinned:
        """Let cells go, all without ids; answers with what stays pinned."""
        gone = set(self._keys)
        unknown: list[str] = []
        if message.ids is not None:
            gone, unknown = self._keys_of(message.ids, None)
        for key in gone & self._keys:
            self._keys.remove(key)
            self._cache.ledger.need_no_more(key)
        self._round = deque(key for key in self._round if key in self._keys)
        return self._answer(message.request, self._keys, unknown)

    def keep(self, now_s: float) -> None:
        """Look at some pins: what is not in memory at its current version is loaded."""
        for _ in range(min(LOOKS_AT_ONCE, len(self._round))):
            key = self._round.popleft()
            self._round.append(key)
            self._keep(key, now_s)

    def _keep(self, key: Key, now_s: float) -> None:
        cache = self._cache
        index = cache.index_of(key.cell_id)
        if index is not None and cache.find_warm(index, key.layer, now_s) is None:
            self._scheduler.want(index, key.layer, BACKGROUND, now_s)

    def _keys_of(self, ids: Iterable[str], layers: tuple[str, ...] | None) -> tuple[set[Key], list[str]]:
        """Keys of cells by id, in these layers (None: in those that are pinned), and ids unknown."""
        keys: set[Key] = set()
        unknown: list[str] = []
        for cell in ids:
            index = self._cache.index_of(cell)
            if index is None:
                unknown.append(cell)
                continue
            cell_id = self._cache.catalogue.id(index)
            names = self.layers_of(cell_id) if layers is None else layers
            keys |= {Key(cell_id, layer) for layer in names}
        return keys, unknown

    def _size(self, key: Key) -> int:
        resident = self._cache.ledger.by_key.get(key)
        if resident is not None:
            return resident.nbytes
        index = self._cache.index_of(key.cell_id)
        return 0 if index is None else self._cache.estimate(index, key.layer)

    def _answer(self, request: int, keys: Iterable[Key], unknown: list[str]) -> messages.Pinned:
        rows = [self._row(key) for key in sorted(keys)]
        return messages.Pinned(request, tuple(rows), tuple(unknown))

    def _row(self, key: Key) -> PinnedCell:
        resident, failure = self._cache.ledger.by_key.get(key), self._scheduler.loads.failures.get(key)
        if resident is not None:
            state = "resident" if self._cache.is_current(resident) else "stale"
        elif self._scheduler.loads.is_promised(key):
            state = "loading"
        else:
            state = failure.code if failure is not None else "absent"
        nbytes = resident.nbytes if resident is not None else 0
        return PinnedCell(self._cache.wire_id(key.cell_id), key.layer, state, nbytes)

# SPDX-License-Identifier: Apache-2.0
"""Cells that operators pin: they are loaded without a request, and never evicted.

A pin applies to a cell and a layer, not to a version: a cell that changes is loaded again, and a load that
fails is repeated.  Pins end with `unpin` or with the daemon.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Generator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Final

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.loading.loads import BACKGROUND
from shmmap.daemon.loading.scheduler import Scheduler
from shmmap.daemon.records import Key
from shmmap.daemon.requests.limits import check_count
from shmmap.errors import BadRequest, OverBudget
from shmmap.layers.spec import canonical_layers
from shmmap.protocol import messages
from shmmap.protocol.messages import PinnedCell
from shmmap.quantities import format_bytes

LOOKS_PER_BEAT: Final = 64
"""Pins checked per beat: about a fifth of a millisecond."""
MAX_PINS: Final = 20_000


def cells_named(
    cache: CellCache, ids: Sequence[str]
) -> Generator[None, None, tuple[list[str], tuple[str, ...]]]:
    """Return the full ids of the cells that an operator names, and the names that match no cell.

    Raises
    ------
    BadRequest
        There are too many names.
    """
    check_count(len(ids))
    known: dict[str, None] = {}
    unknown: list[str] = []
    for cell in ids:
        yield
        index, catalogue = cache.index_of(cell), cache.catalogue
        if index is None:
            unknown.append(cell)
        else:
            known[catalogue.id(index)] = None
    return list(known), tuple(dict.fromkeys(unknown))


@dataclass(eq=False, slots=True)
class OperatorPins:
    """The pinned cells of one map.

    A pin counts in the ledger as another request that waits for the cell, which excludes the cell from
    eviction.
    """

    cache: CellCache
    scheduler: Scheduler
    _keys: OrderedDict[Key, int] = field(default_factory=OrderedDict)  # with their bytes, as last known

    def __contains__(self, key: Key) -> bool:
        return key in self._keys

    def layers_of(self, cell_id: str) -> tuple[str, ...]:
        """Layers in which a cell is pinned."""
        return tuple(sorted(key.layer for key in self._keys if key.cell_id == cell_id))

    def pin(self, message: messages.Pin, now_s: float) -> Generator[None, None, messages.Pinned]:
        """Pin cells; without ids, list the pinned cells.

        Raises
        ------
        OverBudget
            All pins together would exceed the budget.
        BadRequest
            There are too many pins.
        """
        if not message.ids:
            return (yield from self._answer(message.request, list(self._keys), ()))
        cells, unknown = yield from cells_named(self.cache, message.ids)
        wanted = [Key(cell, layer) for cell in cells for layer in canonical_layers(message.layers)]
        check_count(len(wanted))
        new, ledger = dict[Key, int](), self.cache.ledger
        for key in wanted:
            yield
            if key not in self._keys:
                new[key] = self._size(key)
        total = sum(self._keys.values()) + sum(new.values())
        if not ledger.fits_at_all(total):
            raise OverBudget(
                f"with these cells {format_bytes(total)} would be pinned; the budget is"
                f" {format_bytes(ledger.budget_bytes)}",
                hint="unpin others, or serve with a larger --budget",
            )
        if len(self._keys) + len(new) > MAX_PINS:
            raise BadRequest(f"more than {MAX_PINS} cells would be pinned", hint="unpin others")
        for key in wanted:
            yield
            if key not in self._keys:
                ledger.need(key)
                self._keys[key] = new[key]
            self._keep(key, now_s)
        return (yield from self._answer(message.request, wanted, unknown))

    def unpin(self, message: messages.Unpin) -> Generator[None, None, messages.Pinned]:
        """Unpin cells, or all of them without ids; answer with the pins that remain."""
        cells, unknown = yield from cells_named(self.cache, message.ids or ())
        named, ledger = set(cells), self.cache.ledger
        for key in [key for key in self._keys if message.ids is None or key.cell_id in named]:
            del self._keys[key]
            ledger.need_no_more(key)
        return (yield from self._answer(message.request, list(self._keys), unknown))

    def keep(self, now_s: float) -> None:
        """Check some pins, and load those that are not in memory at their current version."""
        for key in list(islice(self._keys, LOOKS_PER_BEAT)):
            self._keys.move_to_end(key)
            self._keep(key, now_s)

    def _keep(self, key: Key, now_s: float) -> None:
        self._keys[key] = self._size(key)
        index = self.cache.index_of(key.cell_id)
        if index is not None and self.cache.find_warm(index, key.layer, now_s) is None:
            self.scheduler.want(self.cache.absent(index, key.layer), BACKGROUND, now_s)

    def _size(self, key: Key) -> int:
        ledger = self.cache.ledger
        if key in ledger.by_key:
            return ledger.by_key[key].nbytes
        index = self.cache.index_of(key.cell_id)
        return 0 if index is None else self.cache.estimate(index, key.layer)

    def _answer(
        self, request: int, keys: Sequence[Key], unknown: tuple[str, ...]
    ) -> Generator[None, None, messages.Pinned]:
        rows = list[PinnedCell]()
        for key in keys:
            yield
            rows.append(self._row(key))
        return messages.Pinned(request, tuple(rows), unknown)

    def _row(self, key: Key) -> PinnedCell:
        ledger, failure = self.cache.ledger, self.scheduler.loads.failures.get(key)
        resident = ledger.by_key.get(key)
        if resident is not None:
            state = "resident" if self.cache.is_current(resident) else "stale"
        elif self.scheduler.loads.is_promised(key):
            state = "loading"
        else:
            state = failure.code if failure is not None else "absent"
        nbytes = resident.nbytes if resident is not None else 0
        return PinnedCell(self.cache.wire_id(key.cell_id), key.layer, state, nbytes)

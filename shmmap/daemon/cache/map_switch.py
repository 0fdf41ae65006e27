# SPDX-License-Identifier: Apache-2.0
"""From one state of the map to the next: what of the memory is still right, and what changed since when."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Final

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.map.catalogue_view import CatalogueView
from shmmap.origin.catalogue import CatalogueChange, compare
from shmmap.segment.version import Stamp

__all__ = ["MapSwitch"]

STATES_REMEMBERED: Final = 64


class MapSwitch:
    """Changes the catalogue that the cache serves, and remembers the changes."""

    def __init__(self, cache: CellCache) -> None:
        self._cache = cache
        self._history: deque[tuple[int, frozenset[str], tuple[str, ...]]] = deque(maxlen=STATES_REMEMBERED)

    def changes_since(self, map_version: int) -> tuple[set[str], list[str]] | None:
        """Ids that changed or appeared, and that vanished, since a map version; None: not known."""
        if map_version == self._cache.catalogue.map_version:
            return set(), []
        history = list(self._history)
        starts = [number for number, entry in enumerate(history) if entry[0] == map_version]
        if not starts:
            return None
        changed: set[str] = set()
        removed: dict[str, None] = {}
        for _version, touched, vanished in history[starts[-1] :]:
            changed |= touched
            changed -= set(vanished)
            removed.update(dict.fromkeys(vanished))
            for cell in touched:
                removed.pop(cell, None)
        return changed, list(removed)

    def catch_up(self, cells: Sequence[int], reads: Sequence[Stamp], known: Sequence[Stamp]) -> bool:
        """Take over the states of files that a loader has read; False if the map may have newer ones.

        Parameters
        ----------
        cells
            Catalogue indices of the cell that was loaded and of the neighbours that it looks into now.
        reads, known
            The files' states as the loader read them, and as the catalogue had them when it was sent.
        """
        if not len(cells) == len(reads) == len(known):
            return False  # the map has got or lost a neighbour meanwhile
        for index, read, before in zip(cells, reads, known, strict=True):
            now = self._cache.catalogue.stamp(index)
            if now != read:
                if now != before:
                    return False  # another state was found since: what was read may have been replaced
                self.learn(index, read)
        return True

    def learn(self, index: int, stamp: Stamp) -> None:
        """A loader found that a cell's file is in this state."""
        cache = self._cache
        if cache.catalogue.stamp(index) == stamp:
            return
        cell_id = cache.catalogue.id(index)
        self._remember({cell_id}, ())
        cache.catalogue.set_stamp(index, stamp)
        cache.chill(index)
        cache.tell(cache.events.changed, cell_id, cache.catalogue.version(index))

    def switch(self, new: CatalogueView, now_s: float) -> CatalogueChange:
        """Serve another state of the map; takes effect cell by cell as cells are asked for."""
        cache = self._cache
        change = compare(cache.catalogue, new)
        if change:
            self._remember({*change.changed, *change.added, *change.moved}, change.removed)
        cache.catalogue = new
        cache.layers.forget()
        if change.added or change.removed:
            cache.forget_indices()
        changed, gone, moved = set(change.changed), set(change.removed), set(change.moved)
        for cold in [index for index in cache.heights if new.id(index) in changed]:
            cache.chill(cold)
        for retired in cache.ledger.retired.values():
            if retired.resident.key.cell_id in moved:
                cache.reclaimer.never_revive(retired.resident.key)
        for resident in list(cache.ledger.residents()):
            cell_id = resident.key.cell_id
            index = cache.index_of(cell_id)
            if index is None or cell_id in gone or cell_id in moved:
                cache.reclaimer.retire(resident, now_s, "map")
                if cell_id not in gone:
                    cache.reclaimer.never_revive(resident.key)  # its header has the old box
                continue
            cache.warm.leave(index, resident.key.layer)
            if resident.checked or cache.is_current(resident):
                cache.enter(resident, index)
            else:
                cache.reclaimer.retire(resident, now_s, "map")
        return change

    def _remember(self, changed: set[str], removed: tuple[str, ...]) -> None:
        self._history.append((self._cache.catalogue.map_version, frozenset(changed), removed))

# SPDX-License-Identifier: Apache-2.0
"""From one state of the map to the next: what of the memory is still right, and what changed since when."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Any, Final

import numpy as np

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.map.catalogue_view import CatalogueView
from shmmap.daemon.records import Resident
from shmmap.large_tables import ShardedDict
from shmmap.origin.catalogue_change import CatalogueChange
from shmmap.segment.version import Stamp

__all__ = ["MapSwitch"]

STATES_REMEMBERED: Final = 64
CELLS_REMEMBERED: Final = 2048
"""Changes of cells, in all states that are remembered; who asks for changes before reads the whole list."""
SEGMENTS_A_STEP: Final = 16
ENTRIES_A_STEP: Final = 512
"""Segments looked at, and entries of tables freed, in one turn: less than a millisecond."""


class MapSwitch:
    """Changes the catalogue that the cache serves, and remembers the changes.

    To change over takes one short step.  What is in memory is then looked at little by little, in `turn`; a
    cell that is asked for meanwhile is looked for at once (`CellCache.find_warm`).
    """

    def __init__(self, cache: CellCache) -> None:
        self._cache = cache
        self._history: deque[tuple[int, frozenset[str], tuple[str, ...]]] = deque(maxlen=STATES_REMEMBERED)
        self._remembered = 0
        self._unseen: Iterator[Resident] | None = None
        self._leftovers: list[ShardedDict[int, Any]] = []

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
        cache.statistics.map_changed()
        cache.catalogue.set_stamp(index, stamp)
        cache.chill(index)
        cache.tell(cache.events.changed, cell_id, cache.catalogue.version(index))

    def switch(self, new: CatalogueView, change: CatalogueChange) -> None:
        """Serve another state of the map; ``change`` is what it differs in from the one served now."""
        cache = self._cache
        if change.known and change.count <= CELLS_REMEMBERED:
            touched = {cell for how in ("changed", "added", "moved") for cell in change.ids(how)}
            if change:
                self._remember(touched, change.ids("removed"))
        else:
            self._history.clear()
            self._remembered = 0
        changed = np.concatenate((change.changed, change.moved))
        cache.statistics.map_changed()
        self._leftovers += cache.serve(new, changed if change.same_cells else None)
        self._unseen = cache.ledger.segments.walk()
        cache.unentered = cache.ledger.resident_count

    def recheck(self) -> None:
        """More of the map is known: segments whose current version was not may be current."""
        self._unseen = self._cache.ledger.segments.walk()
        self._cache.unentered = self._cache.ledger.resident_count

    @property
    def busy(self) -> bool:
        """Whether `turn` has something to do."""
        return bool(self._unseen or self._leftovers)

    @property
    def next_s(self) -> float:
        """When `turn` has something to do: at once, or never."""
        return 0.0 if self.busy else math.inf

    def run_step(self, now_s: float) -> None:
        """Look at some of what is in memory: it is right, out of date, or of no cell of the map any more."""
        cache = self._cache
        if self._unseen is not None:
            some = list(islice(self._unseen, SEGMENTS_A_STEP))
            for resident in some:
                if cache.ledger.resident_named(resident.name) is resident:
                    self._look_at(resident, now_s)
            cache.unentered = max(1, cache.unentered - len(some))
            if len(some) < SEGMENTS_A_STEP:
                self._unseen, cache.unentered = None, 0
        for _ in range(ENTRIES_A_STEP):
            if not self._leftovers:
                break
            if self._leftovers[-1]:
                self._leftovers[-1].popitem()
            else:
                self._leftovers.pop()

    def _look_at(self, resident: Resident, now_s: float) -> None:
        cache, cell = self._cache, resident.key.cell_id
        index = cache.index_of(cell)
        if index is None or cache.catalogue.box(index) != resident.box:
            cache.reclaimer.retire(resident, now_s, "map")
        elif cache.enter_if_current(resident, index):
            cache.tell(cache.rows.show, resident, "resident")
        elif resident.checked:
            cache.tell(cache.rows.show, resident, "stale")
        elif not cache.is_current(resident) and cache.layers.version(index, resident.key.layer):
            cache.reclaimer.retire(resident, now_s, "map")

    def _remember(self, changed: set[str], removed: tuple[str, ...]) -> None:
        history = self._history
        if len(history) == STATES_REMEMBERED:
            self._forget_oldest()
        history.append((self._cache.catalogue.map_version, frozenset(changed), removed))
        self._remembered += len(changed) + len(removed)
        while self._remembered > CELLS_REMEMBERED:
            self._forget_oldest()

    def _forget_oldest(self) -> None:
        _version, changed, removed = self._history.popleft()
        self._remembered -= len(changed) + len(removed)

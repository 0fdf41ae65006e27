# SPDX-License-Identifier: Apache-2.0
"""Switch from one state of the map to the next: which segments are still current, and which cells changed."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Final, NamedTuple

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.map.catalogue_view import CatalogueView
from shmmap.daemon.records import Resident
from shmmap.daemon.turns import Walk
from shmmap.large_tables import ShardedDict
from shmmap.origin.catalogue import CatalogueChange
from shmmap.segment.version import Stamp

CELLS_REMEMBERED: Final = 2048
"""Changed cells remembered, over all states; for changes before these, clients read the whole list."""
FEW: Final = 64
FEW_AMONG_OTHERS: Final = 8
"""Changed cells whose segments are found in one step, in about a millisecond; the second number holds if
there are layers that read neighbouring cells: to find the neighbours takes longer."""


class _Changed(NamedTuple):
    """A cell that changed, appeared or vanished; the first one of each change names the state before it."""

    map_version: int | None
    cell: str
    has_vanished: bool


class MapSwitch:
    """Changes the catalogue that the cache serves, and remembers the changed cells.

    The switch itself is one short step.  Segments are then checked, some per `run_step`; a cell that is
    requested in the meantime is checked at once (`CellCache.find_warm`).  If few cells have changed, only
    their segments are checked; if many have, or cells have new numbers, all that are in memory.

    All cells get other numbers when one is added or removed.  Fixed numbers would need a table of the order
    of ids, and spare no mechanism: a map whose files were all rewritten, and another version of a published
    map, need the check of all segments in any case.
    """

    def __init__(self, cache: CellCache) -> None:
        self._cache = cache
        self._history: deque[_Changed] = deque(maxlen=CELLS_REMEMBERED)
        self._unseen: Walk[Resident] | None = None
        self._leftovers: list[ShardedDict[int, Any] | object] = []
        self._to_free: Walk[None] | None = None

    def changes_since(self, map_version: int) -> tuple[set[str], list[str]] | None:
        """Return ids that changed or appeared, and that vanished, since a map version; None if not known."""
        if map_version == self._cache.catalogue.map_version:
            return set(), []
        history = list(self._history)
        starts = [number for number, entry in enumerate(history) if entry.map_version == map_version]
        if not starts:
            return None
        vanished = {entry.cell: entry.has_vanished for entry in history[starts[-1] :]}  # the last one counts
        removed = [cell for cell in vanished if vanished[cell]]
        return vanished.keys() - removed, removed

    def catch_up(self, cells: Sequence[int], reads: Sequence[Stamp], known: Sequence[Stamp]) -> bool:
        """Record the states of files that a loader has read; return False if the map may have newer ones.

        Parameters
        ----------
        cells
            Catalogue indices of the loaded cell and of the neighbours that it reads now.
        reads, known
            States of the files as the loader read them, and as the catalogue had them when the job was sent.
        """
        if not len(cells) == len(reads) == len(known):
            return False  # the map has gained or lost a neighbour in the meantime
        for index, read, before in zip(cells, reads, known, strict=True):
            now = self._cache.catalogue.stamp(index)
            if now != read:
                if now != before:
                    return False  # another state was found since: what was read may be outdated
                self.learn(index, read)
        return True

    def learn(self, index: int, stamp: Stamp) -> None:
        """Record the state in which a loader found a cell's file."""
        cache = self._cache
        if cache.catalogue.stamp(index) == stamp:
            return
        cell_id = cache.catalogue.id(index)
        self._remember({cell_id}, ())
        cache.statistics.map_changed()
        cache.catalogue.set_stamp(index, stamp)
        cache.invalidate(index)
        cache.events.emit(cache.events.changed, cell_id, cache.catalogue.version(index))

    def switch(self, new: CatalogueView, change: CatalogueChange) -> None:
        """Serve another state of the map; ``change`` is the difference from the state served now."""
        cache = self._cache
        if change.known and change.count <= CELLS_REMEMBERED:
            touched = {cell for how in ("changed", "added", "moved") for cell in change.ids(how)}
            self._remember(touched, change.ids("removed"))
        else:
            self._history.clear()
        cache.statistics.map_changed()
        if self._is_small(change):
            segments = cache.serve_with_few_changes(new, change)
            self._check(segments, len(segments))
        else:
            self._leftovers += cache.serve(new, change)
            self.recheck()
        self._leftovers.append(change.old)
        self._to_free = self._to_free or Walk(self._free_leftovers())

    def _is_small(self, change: CatalogueChange) -> bool:
        """Whether only the segments of changed cells have to be checked, and these can be found at once."""
        if not change.same_numbers or self._unseen is not None:
            return False
        around = self._cache.layers.halo_m(self._cache.ledger.layers()) > 0.0
        return change.count <= (FEW_AMONG_OTHERS if around else FEW)

    def recheck(self) -> None:
        """Check all segments again: more of the map is known, so more segments may be current."""
        self._check(self._cache.ledger.segments.walk(), self._cache.ledger.resident_count)

    def _check(self, segments: Iterable[Resident], count: int) -> None:
        self._unseen, self._cache.unentered = Walk(segments), count

    @property
    def next_s(self) -> float:
        """When `run_step` has something to do: at once, or never."""
        return math.inf if self._unseen is None and self._to_free is None else 0.0

    def run_step(self, now_s: float) -> None:
        """Free some unused tables, or check some segments.

        A segment is current, outdated, or of a cell that left the map.  Tables go first: however often the
        map changes, those of a few states are in memory.
        """
        cache = self._cache
        if self._to_free is not None:
            for _ in self._to_free.for_a_step():
                pass
            if self._to_free.is_done:
                self._to_free = None
        elif self._unseen is not None:
            for resident in self._unseen.for_a_step():
                cache.unentered = max(1, cache.unentered - 1)
                if cache.ledger.resident_named(resident.name) is resident:
                    self._look_at(resident, now_s)
            if self._unseen.is_done:
                self._unseen, cache.unentered = None, 0

    def _free_leftovers(self) -> Iterator[None]:
        """Free unused tables and the state before, one entry or object per step: more at once takes long."""
        while self._leftovers:
            table = self._leftovers.pop()
            while isinstance(table, ShardedDict) and table:
                table.popitem()
                yield
            del table
            yield

    def _look_at(self, resident: Resident, now_s: float) -> None:
        cache, cell = self._cache, resident.key.cell_id
        index = cache.index_of(cell)
        if index is None or cache.catalogue.box(index) != resident.box:
            cache.reclaimer.retire(resident, now_s, "map")
        elif cache.enter_if_current(resident, index) or resident.checked:
            return
        elif not cache.is_current(resident) and cache.layers.version(index, resident.key.layer):
            cache.reclaimer.retire(resident, now_s, "map")

    def _remember(self, changed: Iterable[str], removed: Iterable[str]) -> None:
        """Remember the next change of the served state; the oldest ones are forgotten."""
        version: int | None = self._cache.catalogue.map_version
        for cells, vanish in ((changed, False), (removed, True)):
            for cell in cells:
                self._history.append(_Changed(version, cell, vanish))
                version = None

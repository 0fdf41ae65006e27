# SPDX-License-Identifier: Apache-2.0
"""Outages of a published map's store: noticed, bridged from the disk, and followed by another try.

`DiskAhead` fetches onto the disk what does not fit in memory.  It looks along the same paths as `Prefetcher`,
as far ahead, and begins where `Prefetcher` has no room.  It fetches objects of cells that are neither in
memory nor on the disk, in the order in which they will be needed, and only while no load waits for a loader.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.loading.look_ahead import Prefetch
from shmmap.daemon.loading.scheduler import Scheduler
from shmmap.daemon.map.object_keeper import KeptCell, ObjectKeeper
from shmmap.daemon.map.origin_link import OriginLink
from shmmap.daemon.records import Key
from shmmap.layers.points import LAYER
from shmmap.origin.remote.published_object import ObjectName, unpack_source

__all__ = ["DiskAhead", "OriginWatch"]


LOOK_S: Final = 0.25
"""Interval of looking whether memory has room and whether loads wait, seconds."""
KEPT_S: Final = 60.0
"""How long an object is assumed to stay on the disk, seconds: the disk cache drops unused ones."""
AGAIN_S: Final = 2.0
"""Pause before an object that could not be fetched is tried again, seconds."""
MAX_KNOWN: Final = 1 << 16


@dataclass(eq=False, slots=True)
class OriginWatch:
    """A background task of the serving loop: asks a remote origin whether it answers, when loads fail.

    Parameters
    ----------
    try_again
        Fetches what is missing of the list of cells.
    reload
        Called when there is another version of the map.
    """

    link: OriginLink
    scheduler: Scheduler
    try_again: Callable[[], None]
    reload: Callable[[], None]

    @property
    def next_s(self) -> float:
        """At once when a load could not read what it needs, or never."""
        failed = self.scheduler.prefetcher.health.failed_in_a_row
        return -math.inf if failed and not self.link.is_doubted else math.inf

    def run_step(self, now_s: float) -> None:
        """Find out whether the origin is out of reach."""
        del now_s
        self.link.doubt()

    def collect(self) -> None:
        """Act on what was found out: once the origin answers again, failed loads are repeated."""
        news = self.link.take()
        self.scheduler.note_origin(unreachable=self.link.is_out, back=news.back)
        if news.back:
            self.try_again()
        if news.changed:
            self.reload()


class DiskAhead:
    """A background task of the serving loop, for a published map with a disk cache."""

    def __init__(self, cache: CellCache, scheduler: Scheduler, keeper: ObjectKeeper) -> None:
        self._cache, self._scheduler, self._keeper = cache, scheduler, keeper
        prefetcher = scheduler.prefetcher
        self._prefetch = Prefetch(self._is_lacking, prefetcher.outage_tolerance_s, prefetcher.health)
        self._map_version = 0
        self._rest: dict[tuple[int, str], float] = {}  # until when a layer of a cell is not looked at again
        self._lacking: set[tuple[int, str]] = set()  # not on the disk when they were last looked at
        self._next_s = self._resume_s = -math.inf
        self._now_s = 0.0

    @property
    def next_s(self) -> float:
        """When there is something to do: while clients move."""
        if not self._scheduler.prefetcher.prefetch.paths or self._keeper.free_places <= 0:
            return math.inf
        return self._next_s

    def run_step(self, now_s: float) -> None:
        """Begin with one layer of a cell, if memory has no room for it and no load waits."""
        self._now_s = now_s
        is_asked = now_s >= self._resume_s and self._scheduler.prefetcher.lacks_room(now_s)
        if not is_asked or len(self._scheduler.loads):
            self._prefetch.restart()  # so that it does not keep a catalogue alive meanwhile
            if not is_asked:
                self._forget()
            self._next_s = now_s + LOOK_S
            return
        catalogue = self._cache.catalogue
        if catalogue.map_version != self._map_version or len(self._rest) > MAX_KNOWN:
            self._map_version = catalogue.map_version
            self._rest.clear()  # indices mean other cells
            self._forget()
        self._prefetch.follow_like(self._scheduler.prefetcher.prefetch)
        wish = self._prefetch.next(catalogue, now_s)
        if wish is None:
            self._next_s = now_s if self._prefetch.more else self._prefetch.next_s(now_s)
            if not self._prefetch.more and not self._prefetch.health.is_out:
                self._cache.statistics.set("disk_ahead", int(not self._lacking))
            return
        self._lacking.add((wish.cell, wish.layer))
        self._rest[wish.cell, wish.layer] = math.inf
        key = KeptCell(catalogue.map_version, wish.cell, wish.layer)
        self._keeper.keep(key, self._objects(wish.cell, wish.layer))
        self._next_s = now_s

    def collect(self) -> None:
        """Note what has come."""
        for kept in self._keeper.take():
            map_version, cell, layer = kept.key
            if map_version == self._map_version:
                self._rest[cell, layer] = self._now_s + (KEPT_S if kept.is_here else AGAIN_S)
                if kept.is_here:
                    self._lacking.discard((cell, layer))
            if kept.has_no_room:
                self._resume_s = self._now_s + KEPT_S
        self._next_s = -math.inf

    def _forget(self) -> None:
        self._lacking.clear()
        self._cache.statistics.set("disk_ahead", 0)

    def _is_lacking(self, index: int, layer: str) -> bool:
        """Whether a layer of a cell is neither in memory nor on its way there, and may not be on the disk."""
        if self._now_s < self._rest.get((index, layer), -math.inf):
            return False
        if self._cache.find_warm(index, layer, self._now_s) is not None:
            return False
        return Key(self._cache.catalogue.id(index), layer) not in self._scheduler.loads.by_key

    def _objects(self, index: int, layer: str) -> list[ObjectName]:
        """Return the objects that a loader would need."""
        catalogue, layers = self._cache.catalogue, self._cache.layers
        own = unpack_source(catalogue.source(index))
        if catalogue.ready(index, layer) is not None:
            return [own[layer].name]
        around = layers.neighbours(index, layer)
        return [own[LAYER].name, *(unpack_source(catalogue.source(near))[LAYER].name for near in around)]

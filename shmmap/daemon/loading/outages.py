# SPDX-License-Identifier: Apache-2.0
"""Outages of a published map's store: detected, bridged from the disk, and followed by retries.

`DiskAhead` fetches onto the disk cells that do not fit in memory.  It reads the same list as `Prefetcher`
(`shmmap.daemon.loading.look_ahead`) when that has no memory left.  It fetches the objects of cells that are
neither in memory nor on the disk, in the order in which they will be needed, and only while no load waits for
a loader and the link has room (`shmmap.daemon.loading.link`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.loading.look_ahead import Reader
from shmmap.daemon.loading.published_reader import needed_objects
from shmmap.daemon.loading.scheduler import Scheduler, job_of
from shmmap.daemon.map.object_keeper import KeptCell, ObjectKeeper
from shmmap.daemon.map.origin_link import OriginLink
from shmmap.daemon.records import Key
from shmmap.layers.spec import layer_spec

LOOK_S: Final = 0.25
"""Interval of checking whether memory has room and whether loads wait, seconds."""
RESTART_S: Final = 1.0
"""Interval of starting the thread that polls, if it does not run, seconds."""
KEPT_S: Final = 60.0
"""How long an object is assumed to stay on the disk, seconds: the disk cache drops unused ones."""
AGAIN_S: Final = 2.0
"""Delay before a failed fetch of an object is repeated, seconds."""
MAX_KNOWN: Final = 1 << 16


@dataclass(eq=False, slots=True)
class OriginWatch:
    """A background task of the serving loop: checks whether a remote origin answers when loads fail.

    Parameters
    ----------
    try_again
        Fetches the missing pages of the list of cells.
    reload
        Called when a new version of the map exists.
    """

    link: OriginLink
    scheduler: Scheduler
    try_again: Callable[[], None]
    reload: Callable[[], None]
    _restart_s: float = -math.inf

    @property
    def next_s(self) -> float:
        """At once when a load could not read its source or nothing polls, else never."""
        if self.link.is_lost:
            return self._restart_s
        failed = self.scheduler.prefetcher.health.failed_in_a_row
        return -math.inf if failed and not self.link.is_doubted else math.inf

    def run_step(self, now_s: float) -> None:
        """Start a check of whether the origin is reachable."""
        if self.link.is_lost:
            self._restart_s = now_s + RESTART_S
            self.link.restart()
        else:
            self.link.doubt()

    def collect(self) -> None:
        """Handle the result of the check: once the origin answers again, failed loads are repeated."""
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
        self._prefetch, self._reader = scheduler.prefetcher.prefetch, Reader(self._is_lacking)
        self._map_version = 0
        self._rest: dict[tuple[int, str], float] = {}  # until when a layer of a cell is not checked again
        self._lacking: set[tuple[int, str]] = set()  # not on the disk when last checked
        self._next_s = self._resume_s = -math.inf
        self._now_s = 0.0

    @property
    def next_s(self) -> float:
        """When there is something to do; never while no client moves."""
        if not self._prefetch.paths or self._keeper.free_places <= 0:
            return math.inf
        return self._next_s

    def run_step(self, now_s: float) -> None:
        """Start fetching one layer of a cell, if memory has no room for it and no load waits."""
        self._now_s = now_s
        link = self._scheduler.link
        is_asked = now_s >= self._resume_s and self._scheduler.prefetcher.lacks_room(now_s)
        may_begin = link is None or link.may_begin(now_s, ahead=True)
        if not is_asked or len(self._scheduler.loads) or not may_begin:
            if not is_asked:
                self._forget()
            self._next_s = now_s + LOOK_S
            return
        catalogue = self._cache.catalogue
        if catalogue.map_version != self._map_version or len(self._rest) > MAX_KNOWN:
            self._map_version = catalogue.map_version
            self._rest.clear()  # indices mean other cells
            self._forget()
        wish = self._prefetch.next(catalogue, now_s, self._reader)
        if wish is None:
            self._next_s = self._prefetch.next_s(now_s, self._reader)
            if self._next_s > now_s and not self._prefetch.health.is_out:
                self._cache.statistics.set("disk_ahead", int(not self._lacking))
            return
        self._lacking.add((wish.cell, wish.layer))
        self._rest[wish.cell, wish.layer] = math.inf
        key = KeptCell(catalogue.map_version, wish.cell, wish.layer)
        job = job_of(self._cache, 0, wish.cell, wish.layer, 0)
        objects = list(needed_objects(layer_spec(job.layer), job))
        if link is not None:
            link.begin(key, sum(one.size for one in objects), now_s, "ahead")
        self._keeper.keep(key, objects)
        self._next_s = now_s

    def collect(self) -> None:
        """Note the objects that have been fetched."""
        for kept in self._keeper.take():
            map_version, cell, layer = kept.key
            if self._scheduler.link is not None:
                self._scheduler.link.end(kept.key, kept.received)
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
        """Whether a layer of a cell is neither in memory nor being loaded, and may not be on the disk."""
        if self._now_s < self._rest.get((index, layer), -math.inf):
            return False
        if self._cache.find_warm(index, layer, self._now_s) is not None:
            return False
        return Key(self._cache.catalogue.id(index), layer) not in self._scheduler.loads.by_key

# SPDX-License-Identifier: Apache-2.0
"""A new state of the map takes over: waiting requests, memory and loads follow it."""

from __future__ import annotations

import time
from dataclasses import dataclass

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.cache.map_switch import MapSwitch
from shmmap.daemon.events.log import EventLog
from shmmap.daemon.events.map_events import tell_reload, tell_reload_failed
from shmmap.daemon.loading.scheduler import Scheduler
from shmmap.daemon.map.catalogue_reload import Reloader
from shmmap.daemon.requests.cell_requests import CellRequests
from shmmap.errors import ShmmapError
from shmmap.logfmt import log
from shmmap.origin.catalogue import Catalogue
from shmmap.statistics.writer import StatisticsWriter

__all__ = ["MapChange"]


@dataclass(eq=False, slots=True)
class MapChange:
    """Carries out what a reload found."""

    reloader: Reloader
    cells: CellRequests
    cache: CellCache
    scheduler: Scheduler
    map_switch: MapSwitch
    event_log: EventLog
    statistics: StatisticsWriter

    def collect(self) -> None:
        """A reload is over: serve what it found, and tell those who asked for it."""
        self.reloader.collect(self.apply, self._keep)

    def apply(self, catalogue: Catalogue) -> None:
        """Serve another state of the map from now on."""
        cache, old, now_s = self.cache, self.cache.catalogue, time.monotonic()
        self.cells.renumber(lambda index: catalogue.find(old.id(index)), old.id)
        change = self.map_switch.switch(catalogue, now_s)
        self.scheduler.drop(change.removed)
        cache.tell_all()
        tell_reload(self.event_log, self.statistics, catalogue, change, cache.wire_id)
        counts = {name: len(getattr(change, name)) for name in ("changed", "moved", "added", "removed")}
        log.info("reload done", cells=len(catalogue), **counts)
        self.statistics.set("map_problems", len(catalogue.problems))
        for problem in catalogue.problems:
            log.warning("problem in the map", what=problem)

    def _keep(self, error: ShmmapError) -> None:
        tell_reload_failed(self.event_log, self.statistics, self.cache.catalogue.map_version, error)

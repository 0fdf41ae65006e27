# SPDX-License-Identifier: Apache-2.0
"""A new state of the map takes over: waiting requests, memory and loads follow it."""

from __future__ import annotations

import logging
import time

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.cache.map_switch import MapSwitch
from shmmap.daemon.events.log import EventLog
from shmmap.daemon.events.map_events import tell_reload, tell_reload_failed
from shmmap.daemon.loading.scheduler import Scheduler
from shmmap.daemon.map.catalogue_reload import Reloader
from shmmap.daemon.requests.cell_requests import CellRequests
from shmmap.errors import ShmmapError
from shmmap.origin.catalogue import Catalogue
from shmmap.statistics.writer import StatisticsWriter

__all__ = ["MapChange"]

_log = logging.getLogger(__name__)


class MapChange:
    """Carries out what a reload found."""

    def __init__(
        self,
        reloader: Reloader,
        cells: CellRequests,
        cache: CellCache,
        scheduler: Scheduler,
        map_switch: MapSwitch,
        event_log: EventLog,
        statistics: StatisticsWriter,
    ) -> None:
        self._reloader = reloader
        self._cells = cells
        self._cache = cache
        self._scheduler = scheduler
        self._map_switch = map_switch
        self._event_log = event_log
        self._statistics = statistics

    def collect(self) -> None:
        """A reload is over: serve what it found, and tell those who asked for it."""
        self._reloader.collect(self.apply, self._keep)

    def apply(self, catalogue: Catalogue) -> None:
        """Serve another state of the map from now on."""
        cache, old, now_s = self._cache, self._cache.catalogue, time.monotonic()
        self._cells.renumber(lambda index: catalogue.find(old.id(index)), old.id)
        change = self._map_switch.switch(catalogue, now_s)
        self._scheduler.drop(change.removed)
        cache.tell_all()
        tell_reload(self._event_log, self._statistics, catalogue, change, cache.wire_id)
        _log.info(
            "map read again: %d cells changed, %d added, %d removed",
            len(change.changed), len(change.added), len(change.removed),
        )  # fmt: skip
        for problem in catalogue.problems:
            _log.warning("%s", problem)

    def _keep(self, error: ShmmapError) -> None:
        tell_reload_failed(self._event_log, self._statistics, self._cache.catalogue.map_version, error)

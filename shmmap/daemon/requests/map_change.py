# SPDX-License-Identifier: Apache-2.0
"""Switch to a new state of the map: requests, memory and loads follow, and the change is published."""

from __future__ import annotations

import itertools
import time
from dataclasses import dataclass
from typing import Final

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.cache.map_switch import MapSwitch
from shmmap.daemon.events.log import EventLog
from shmmap.daemon.loading.scheduler import Scheduler
from shmmap.daemon.map.catalogue_reload import Reloader, Reread
from shmmap.daemon.requests.paging import Paging
from shmmap.errors import ShmmapError
from shmmap.logfmt import log
from shmmap.origin.catalogue import CatalogueChange
from shmmap.protocol import events

MAX_NAMED: Final = 64
"""Changed cells with an event each: a rewritten map has a million; `metadata` lists them all."""
MAX_PROBLEMS: Final = 64
"""Map problems logged per reload."""


@dataclass(eq=False, slots=True)
class MapChange:
    """Applies the result of a reload."""

    reloader: Reloader
    cache: CellCache
    scheduler: Scheduler
    map_switch: MapSwitch
    event_log: EventLog
    paging: Paging

    def collect(self) -> None:
        """Serve the result of a reload, and answer the operators that asked for it."""
        self.reloader.collect(self._apply, self._keep)

    def _apply(self, reread: Reread) -> Reread | None:
        """Serve another state of the map from now on; return None if too little of it is known yet."""
        statistics, catalogue = self.cache.statistics, reread.catalogue
        if catalogue.pages is not None:  # compare again: more of both states is known by now
            reread = Reread(catalogue, catalogue.changes_from(self.cache.catalogue))
        if not self.paging.is_ready(catalogue, self._try_again):
            return None
        self.map_switch.switch(catalogue, reread.change)
        self.scheduler.map_changed()
        self.paging.follow()
        statistics.add("reloads")
        statistics.set("last_reload_unix_ns", time.time_ns())
        statistics.set("last_reload_failed", 0)
        statistics.set("map_problems", len(catalogue.problems))
        self._publish(reread.change)
        for problem in itertools.islice(catalogue.problems, MAX_PROBLEMS):
            log.warning("problem in the map", what=problem)
        return reread

    def _try_again(self) -> None:
        """Serve the state of the map that was held back, if enough of it is known now."""
        self.reloader.apply_held(self._apply)

    def _publish(self, change: CatalogueChange) -> None:
        """Log and publish the changes of the map."""
        cache, catalogue = self.cache, self.cache.catalogue
        counts = {how: len(getattr(change, how)) for how in ("changed", "moved", "added", "removed")}
        named = [(how, cell) for how in counts for cell in change.ids(how, MAX_NAMED)][:MAX_NAMED]
        log.info("reload done", cells=len(catalogue), **counts)
        self.event_log.publish(
            events.Reloaded, catalogue.map_version, counts["changed"] + counts["moved"], counts["added"],
            counts["removed"], len(named),
        )  # fmt: skip
        for how, cell in named:
            index = catalogue.find(cell) if how != "removed" else None
            version = catalogue.version(index) if index is not None else 0
            self.event_log.publish(events.Changed, cache.wire_id(cell), version, how)

    def _keep(self, error: ShmmapError) -> None:
        """Keep the old state of the map because reading the new one failed."""
        statistics, catalogue = self.cache.statistics, self.cache.catalogue
        statistics.add("reloads_failed")
        statistics.set("last_reload_failed", 1)
        self.event_log.publish(events.Reloaded, catalogue.map_version, 0, 0, 0, 0, error.message)

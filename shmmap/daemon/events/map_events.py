# SPDX-License-Identifier: Apache-2.0
"""Telling what a reload changed in the map, in the statistics and as events."""

from __future__ import annotations

import time
from typing import Final

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.events.log import EventLog
from shmmap.errors import ShmmapError
from shmmap.origin.catalogue import CatalogueChange
from shmmap.protocol import events
from shmmap.statistics.writer import StatisticsWriter

__all__ = ["tell_reload", "tell_reload_failed"]

CELLS_TOLD: Final = 256
"""Changed cells named one by one: a map written anew has a million; `metadata` names them all."""


def tell_reload(
    log: EventLog, statistics: StatisticsWriter, cache: CellCache, change: CatalogueChange
) -> None:
    """Say that the cache serves another state of the map, and what is new in it."""
    statistics.add("reloads")
    statistics.set("last_reload_unix_ns", time.time_ns())
    statistics.set("last_reload_failed", 0)
    kinds = {
        "changed": change.changed,
        "moved": change.moved,
        "added": change.added,
        "removed": change.removed,
    }
    named = [(how, cell) for how, cells in kinds.items() for cell in list(cells)[:CELLS_TOLD]][:CELLS_TOLD]
    log.publish(
        events.Reloaded,
        cache.catalogue.map_version,
        len(change.changed) + len(change.moved),
        len(change.added),
        len(change.removed),
        len(named),
    )
    for how, cell in named:
        index = cache.index_of(cell) if how != "removed" else None
        version = cache.catalogue.version(index) if index is not None else 0
        log.publish(events.Changed, cache.wire_id(cell), version, how)


def tell_reload_failed(
    log: EventLog, statistics: StatisticsWriter, cache: CellCache, error: ShmmapError
) -> None:
    """Say that the map could not be read again; the old state of it stays."""
    statistics.add("reloads_failed")
    statistics.set("last_reload_failed", 1)
    log.publish(events.Reloaded, cache.catalogue.map_version, 0, 0, 0, 0, error.message)

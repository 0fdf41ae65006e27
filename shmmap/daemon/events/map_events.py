# SPDX-License-Identifier: Apache-2.0
"""Telling what a reload changed in the map, in the statistics and as events."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

from shmmap.daemon.events.log import EventLog
from shmmap.daemon.map.catalogue_view import CatalogueView
from shmmap.errors import ShmmapError
from shmmap.origin.catalogue import CatalogueChange
from shmmap.protocol import events
from shmmap.statistics.writer import StatisticsWriter

__all__ = ["tell_reload", "tell_reload_failed"]

CELLS_TOLD: Final = 256
"""Changed cells named one by one: a map written anew has a million; `metadata` names them all."""


def tell_reload(
    log: EventLog,
    statistics: StatisticsWriter,
    catalogue: CatalogueView,
    change: CatalogueChange,
    wire_id: Callable[[str], str],
) -> None:
    """Say that another state of the map is served, and what is new in it; ``wire_id`` shortens cell ids."""
    statistics.add("reloads")
    statistics.set("last_reload_unix_ns", time.time_ns())
    statistics.set("last_reload_failed", 0)
    kinds = {
        "changed": change.changed,
        "moved": change.moved,
        "added": change.added,
        "removed": change.removed,
    }
    named = [(how, cell) for how, cells in kinds.items() for cell in cells[:CELLS_TOLD]][:CELLS_TOLD]
    changed, added, removed = len(change.changed) + len(change.moved), len(change.added), len(change.removed)
    log.publish(events.Reloaded, catalogue.map_version, changed, added, removed, len(named))
    for how, cell in named:
        index = catalogue.find(cell) if how != "removed" else None
        version = catalogue.version(index) if index is not None else 0
        log.publish(events.Changed, wire_id(cell), version, how)


def tell_reload_failed(
    log: EventLog, statistics: StatisticsWriter, map_version: int, error: ShmmapError
) -> None:
    """Say that the map could not be read again; the old state of it stays."""
    statistics.add("reloads_failed")
    statistics.set("last_reload_failed", 1)
    log.publish(events.Reloaded, map_version, 0, 0, 0, 0, error.message)

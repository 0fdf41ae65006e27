# SPDX-License-Identifier: Apache-2.0
"""Telling what happens to cells: as events, and whether the cache is large enough."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from shmmap.daemon.events.eviction_history import EvictionHistory
from shmmap.daemon.events.late_cells import LateCells
from shmmap.daemon.events.log import EventLog, MinuteLog, PressureEvents
from shmmap.daemon.records import SPACE_CODES, Failure, Key, Resident
from shmmap.layers.points import LAYER
from shmmap.logfmt import log
from shmmap.protocol import events
from shmmap.statistics.writer import StatisticsWriter

__all__ = ["CellEvents"]


@dataclass(eq=False, slots=True)
class CellEvents:
    """Hears of cells and tells of them.

    Parameters
    ----------
    wire_id
        Makes of a cell id what replies and events carry.
    pressure
        Tells of cells that were refused for lack of memory.

    Attributes
    ----------
    late
        Tells of cells that clients on their way had to wait for.
    minutes
        Logs how many were evicted, and how many clients left, a line a minute.
    """

    event_log: EventLog
    statistics: StatisticsWriter
    wire_id: Callable[[str], str]
    pressure: PressureEvents
    late: LateCells = field(init=False)
    minutes: MinuteLog = field(default_factory=MinuteLog)
    _history: EvictionHistory = field(default_factory=EvictionHistory)

    def __post_init__(self) -> None:
        self.late = LateCells(self.event_log)

    def loaded(self, resident: Resident, took_ns: int, replaces: int, cached: bool, ahead: bool) -> None:
        """A segment was loaded and published; ``took_ns`` from handing the load to a worker.

        ``cached`` says that it came out of the disk cache, ``ahead`` that nobody had asked for it yet.
        """
        again = self._tell_loaded(resident, resident.load_ns, replaces, ahead)
        self.late.arrived(self.wire_id(resident.key.cell_id), resident.key.layer)
        points = resident.key.layer == LAYER
        source = "load_cached" if cached else "load_points" if points else "load_computed"
        self.statistics.add_duration(source, resident.load_ns)
        self.statistics.add("loads_from_cache", cached)
        self.statistics.add("layers_computed", source == "load_computed")
        self.statistics.add("loads_finished")
        self.statistics.add("bytes_loaded", resident.nbytes)
        self.statistics.add("loads_after_eviction", again)
        self.statistics.add_duration("load", took_ns)

    def revived(self, resident: Resident) -> None:
        """A retired segment is in service again, without a load."""
        self._tell_loaded(resident, 0, 0, ahead=False)

    def _tell_loaded(self, resident: Resident, load_ns: int, replaces: int, ahead: bool) -> bool:
        """Tell of a segment in service; returns whether it had been evicted to make room."""
        again = self._history.loaded(resident.key, resident.version)
        self.event_log.publish(
            events.Loaded, self.wire_id(resident.key.cell_id), resident.key.layer, resident.version,
            resident.nbytes, resident.points, load_ns, again, replaces, ahead,
        )  # fmt: skip
        return again

    def changed(self, cell_id: str, version: int) -> None:
        """A load found that a cell's file is not the one the catalogue knows."""
        self.event_log.publish(events.Changed, self.wire_id(cell_id), version, "changed")

    def retired(self, resident: Resident, why: str) -> None:
        """A segment left service; of superseded ones their successor's event tells."""
        if why == "room":
            self._history.evicted(resident.key, resident.version)
        if why != "superseded":
            cell, layer = resident.key
            reason = "budget" if why == "room" else why
            log.debug("evicted", cell=cell, layer=layer, bytes=resident.nbytes, reason=reason)
            self.minutes.count("cells evicted", reason, resident.nbytes)
            self.event_log.publish(
                events.Evicted, self.wire_id(cell), layer, resident.version, resident.nbytes, why
            )

    def failed(self, key: Key, failure: Failure, now_s: float) -> None:
        """A load ended without a segment."""
        wire_id = self.wire_id(key.cell_id)
        if failure.code in SPACE_CODES:
            self.pressure.refused(wire_id, key.layer, failure.code, now_s)
        else:
            self.event_log.publish(
                events.Failed, wire_id, key.layer, failure.code, failure.message, failure.delay_s
            )

    def retried(self, key: Key, failure: Failure) -> None:
        """A cell that failed is about to be loaded again."""
        if failure.code not in SPACE_CODES:
            self.event_log.publish(events.Retried, self.wire_id(key.cell_id), key.layer, failure.code)

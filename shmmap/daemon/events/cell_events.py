# SPDX-License-Identifier: Apache-2.0
"""Events of cells: loads, evictions, failures, prefetch misses; and what was loaded again after eviction."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import islice
from typing import Final

from shmmap.daemon.events.log import EventLog, MinuteLog, PressureEvents
from shmmap.daemon.records import SPACE_CODES, Failure, Key, Resident
from shmmap.daemon.transport.sessions import Session
from shmmap.layers.points import LAYER
from shmmap.logfmt import log
from shmmap.protocol import events
from shmmap.statistics.writer import StatisticsWriter

__all__ = ["CellEvents", "EvictionHistory", "PrefetchMisses"]

MAX_EVICTED: Final = 1 << 14
"""Segments evicted to make room that are remembered."""


class EvictionHistory:
    """The last keys that were evicted to make room: if one is loaded again, the cache was too small.

    The same idea as the ghost lists of ARC (Megiddo and Modha, FAST 2003), used for reports only.
    """

    def __init__(self) -> None:
        self._versions: OrderedDict[Key, int] = OrderedDict()  # a dict finds its oldest one slowly

    def __len__(self) -> int:
        return len(self._versions)

    def evicted(self, key: Key, version: int) -> None:
        """Note that this version made room for others."""
        self._versions.pop(key, None)
        self._versions[key] = version
        if len(self._versions) > MAX_EVICTED:
            self._versions.popitem(last=False)

    def loaded(self, key: Key, version: int) -> bool:
        """Whether a load brought back just what had been evicted to make room."""
        return self._versions.pop(key, None) == version


QUIET_S: Final = 1.0
"""A client's prefetch misses are one event at most in this time."""
MAX_EVENTS_PER_TURN: Final = 16
"""Clients looked at in one turn: many of them must not drive all else out of the log."""
MAX_MISSED_CELLS: Final = 1 << 12
MAX_WAITING_CLIENTS: Final = 1 << 8
"""Cells that are remembered as waited for, and clients that wait for one."""


@dataclass(eq=False, slots=True)
class _Waited:
    """Prefetch misses of one client that are no event yet, and until when they stay none."""

    session: int
    pid: int
    client: str
    cells: int = 0
    cell_id: str = ""
    layer: str = ""
    quiet_until_s: float = float("-inf")


class PrefetchMisses:
    """Cells that moving clients had to wait for: of each client one event a second, also after its end.

    A client that asks again for a cell that has not come meanwhile waits on, and that is no other wait.
    """

    def __init__(self, log: EventLog) -> None:
        self._log = log
        self._absent: OrderedDict[tuple[str, str], set[int]] = OrderedDict()  # sessions that wait for it
        self._waited: OrderedDict[int, _Waited] = OrderedDict()  # by session; the next one first

    def __len__(self) -> int:
        """How many clients are remembered."""
        return len(self._waited)

    def arrived(self, cell_id: str, layer: str) -> None:
        """Note that no client waits for a cell any more."""
        self._absent.pop((cell_id, layer), None)

    def note(self, session: Session, cell_id: str, layer: str) -> bool:
        """Note that a client has to wait for a cell; False if it does so already.

        Parameters
        ----------
        cell_id
            As replies carry it.
        """
        waiting = self._absent.setdefault((cell_id, layer), set())
        if session.slot in waiting:
            return False
        if len(waiting) >= MAX_WAITING_CLIENTS:
            waiting.clear()
        waiting.add(session.slot)
        if len(self._absent) > MAX_MISSED_CELLS:
            self._absent.popitem(last=False)
        one = self._waited.get(session.slot)
        if one is None:
            name = session.client or session.command
            one = self._waited[session.slot] = _Waited(session.slot, session.peer.pid, name)
        one.cells += 1
        one.cell_id, one.layer = cell_id, layer
        return True

    def turn(self, now_s: float) -> None:
        """Publish the events of some clients, the longest pending first."""
        for slot, one in list(islice(self._waited.items(), MAX_EVENTS_PER_TURN)):
            if now_s < one.quiet_until_s:
                self._waited.move_to_end(slot)
            elif one.cells:
                self._log.publish(
                    events.PrefetchMiss, one.session, one.pid, one.client, one.cells, one.cell_id, one.layer
                )
                one.cells, one.quiet_until_s = 0, now_s + QUIET_S
                self._waited.move_to_end(slot)
            else:
                del self._waited[slot]


@dataclass(eq=False, slots=True)
class CellEvents:
    """Publishes what happens to cells, and counts it.

    Parameters
    ----------
    wire_id
        Makes of a cell id what replies and events carry.
    pressure
        Events of cells that were refused for lack of memory.
    """

    event_log: EventLog
    statistics: StatisticsWriter
    wire_id: Callable[[str], str]
    pressure: PressureEvents
    prefetch_misses: PrefetchMisses = field(init=False)
    minutes: MinuteLog = field(default_factory=MinuteLog)
    _history: EvictionHistory = field(default_factory=EvictionHistory)

    def __post_init__(self) -> None:
        self.prefetch_misses = PrefetchMisses(self.event_log)

    def loaded(self, resident: Resident, took_ns: int, replaces: int, cached: bool, ahead: bool) -> None:
        """A segment was loaded and published; ``took_ns`` from handing the load to a worker.

        ``cached`` says that it came out of the disk cache, ``ahead`` that nobody had asked for it yet.
        """
        again = self._publish_loaded(resident, resident.load_ns, replaces, ahead)
        self.prefetch_misses.arrived(self.wire_id(resident.key.cell_id), resident.key.layer)
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
        self._publish_loaded(resident, 0, 0, ahead=False)

    def _publish_loaded(self, resident: Resident, load_ns: int, replaces: int, ahead: bool) -> bool:
        """Publish that a segment is in service; return whether it had been evicted to make room."""
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

# SPDX-License-Identifier: Apache-2.0
"""Reports about cells: as events, log lines and counters.

Nothing is reported while a client waits for the loop: `CellEvents.emit` queues it, `CellEvents.flush`
reports.
"""

from __future__ import annotations

import math
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice
from typing import Any, Final

from shmmap.daemon.events.log import EventLog, MinuteLog
from shmmap.daemon.records import SPACE_CODES, Failure, Key, Resident
from shmmap.daemon.transport.sessions import Session
from shmmap.layers.points import LAYER
from shmmap.logfmt import log
from shmmap.protocol import events
from shmmap.statistics.writer import StatisticsWriter

MAX_EVICTED: Final = 1 << 14
"""Number of segments evicted for lack of memory that are remembered."""
PRESSURE_S: Final = 1.0
LOG_S: Final = 60.0
_SETTINGS: Final = {
    "over_budget": "budget (--budget): raise it, or have clients hold less",
    "quota": "session_quota (--session-quota): raise it, or have this client hold less",
    "no_space": "shm_dir (--shm-dir): its file system is full, or smaller than the budget",
}
"""Setting that an operator can change, by the code of a refusal."""


class PressureEvents:
    """Refusals of cells for lack of memory: at most one event a second and one log line a minute.

    Parameters
    ----------
    memory
        Returns budget, used, pinned and retired bytes.
    holder
        Returns a description of the session that holds most of the memory.
    """

    def __init__(
        self,
        event_log: EventLog,
        memory: Callable[[], tuple[int, int, int, int]],
        holder: Callable[[], str] = str,
    ) -> None:
        self._event_log = event_log
        self._memory = memory
        self._holder = holder
        self._refused = 0
        self._unlogged = 0
        self._last: tuple[str, str, str] = ("", "", "")
        self._published_s = self._logged_s = float("-inf")

    def note_refusal(self, cell_id: str, layer: str, code: str, now_s: float) -> None:
        """Note that a cell was refused."""
        self._refused += 1
        self._unlogged += 1
        self._last = (cell_id, layer, code)
        self.step(now_s)

    def step(self, now_s: float) -> None:
        """Publish and log the refusals not yet reported, if the interval has passed."""
        if self._refused and now_s - self._published_s >= PRESSURE_S:
            self._event_log.publish(events.Pressure, *self._last, self._refused, *self._memory())
            self._refused, self._published_s = 0, now_s
        if now_s - self._logged_s >= LOG_S:
            self._log(now_s)

    def close(self) -> None:
        """Log the refusals not yet reported: there will be no later line."""
        self._log(self._logged_s)

    def _log(self, now_s: float) -> None:
        if self._unlogged:
            cell, layer, code = self._last
            budget, used, pinned, _ = self._memory()
            log.warning(
                "cells refused for lack of memory",
                count=self._unlogged,
                code=code,
                last=cell,
                layer=layer,
                budget_bytes=budget,
                used_bytes=used,
                in_use_bytes=pinned,
                most_is_held_by=self._holder() or None,
                setting=_SETTINGS.get(code),
            )
            self._unlogged, self._logged_s = 0, now_s


class EvictionHistory:
    """Keys recently evicted for lack of memory: if one is loaded again, the cache was too small.

    As the ghost lists of ARC (Megiddo and Modha, FAST 2003), but used for reports only.
    """

    def __init__(self) -> None:
        self._versions: OrderedDict[Key, int] = OrderedDict()  # a dict is slow at finding its oldest key

    def note_eviction(self, key: Key, version: int) -> None:
        """Note that this version was evicted for lack of memory."""
        self._versions.pop(key, None)
        self._versions[key] = version
        if len(self._versions) > MAX_EVICTED:
            self._versions.popitem(last=False)

    def take_eviction(self, key: Key, version: int) -> bool:
        """Forget the eviction of a key that is loaded again; return whether it was of this version."""
        return self._versions.pop(key, None) == version


QUIET_S: Final = 1.0
"""Minimum time between two prefetch-miss events of one client."""
MAX_EVENTS_PER_TURN: Final = 16
"""Clients handled in one turn: their events must not displace all others from the log."""
MAX_MISSED_CELLS: Final = 1 << 12
MAX_WAITING_CLIENTS: Final = 1 << 8
"""Limit of cells whose misses are remembered, and of clients remembered for each of them."""


@dataclass(eq=False, slots=True)
class _Waited:
    """Prefetch misses of one client not published yet, and until when they are held back."""

    session: int
    pid: int
    client: str
    cells: int = 0
    cell_id: str = ""
    layer: str = ""
    quiet_until_s: float = float("-inf")


class PrefetchMisses:
    """Cells that moving clients had to wait for: one event a second per client, also after its session ended.

    A client that asks again for a cell that has not arrived continues the same wait.
    """

    def __init__(self, log: EventLog) -> None:
        self._log = log
        self._absent: OrderedDict[tuple[str, str], set[int]] = OrderedDict()  # sessions that wait for each
        self._waited: OrderedDict[int, _Waited] = OrderedDict()  # by session; the next one to publish first

    def note_arrival(self, cell_id: str, layer: str) -> None:
        """Note that a cell has arrived, so that no client waits for it any more."""
        self._absent.pop((cell_id, layer), None)

    def note_wait(self, session: Session, cell_id: str, layer: str) -> bool:
        """Note that a client has to wait for a cell; return False if it already waits for it.

        Parameters
        ----------
        cell_id
            Id as in replies.
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

    def publish_due(self, now_s: float) -> None:
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


class CellEvents:
    """Reports the events of cells: to subscribers, the log and the statistics.

    Parameters
    ----------
    pressure
        Reports cells that were refused for lack of memory.
    id_prefix
        Prefix that is removed from the cell ids in reports.

    Attributes
    ----------
    minutes : MinuteLog
        Log lines about frequent events.
    """

    def __init__(
        self,
        event_log: EventLog,
        statistics: StatisticsWriter,
        pressure: PressureEvents,
        *,
        id_prefix: str,
    ) -> None:
        self._log = event_log
        self._statistics = statistics
        self._pressure = pressure
        self._id_prefix = id_prefix
        self.minutes = MinuteLog()
        self._misses = PrefetchMisses(event_log)
        self._history = EvictionHistory()
        self._pending: deque[tuple[Callable[..., None], tuple[Any, ...]]] = deque()

    # --- after clients have been answered -----------------------------------------------------------

    def emit(self, report: Callable[..., None], *what: Any) -> None:
        """Queue a report until no client waits for the loop; see `flush`."""
        self._pending.append((report, what))

    @property
    def pending(self) -> bool:
        """Whether reports are queued."""
        return bool(self._pending)

    def flush_one(self) -> None:
        """Report the first queued item, if there is one."""
        if self._pending:
            report, what = self._pending.popleft()
            report(*what)

    def flush(self) -> None:
        """Report all queued items."""
        while self._pending:
            self.flush_one()

    def step(self, now_s: float) -> None:
        """Publish and log periodic reports, a few times a second."""
        self._pressure.step(now_s)
        self.minutes.step(now_s)
        self._misses.publish_due(now_s)

    def close(self) -> None:
        """Log what the lines of this minute would have counted."""
        self.flush()
        self._pressure.close()
        self.minutes.step(math.inf)

    # --- what happens -------------------------------------------------------------------------------

    def _id(self, cell_id: str) -> str:
        """Return a cell id as replies and events carry it."""
        return cell_id.removeprefix(self._id_prefix)

    def loaded(self, resident: Resident, took_ns: int, replaces: int, cached: bool, ahead: bool) -> None:
        """Report that a segment was loaded and published; ``took_ns`` from handing the load to a worker.

        ``cached``: the layer came from the disk cache; ``ahead``: no client had asked for it yet.
        """
        again = self._publish_loaded(resident, resident.load_ns, replaces, ahead)
        self._misses.note_arrival(self._id(resident.key.cell_id), resident.key.layer)
        points = resident.key.layer == LAYER
        source = "load_cached" if cached else "load_points" if points else "load_computed"
        statistics = self._statistics
        statistics.add_duration(source, resident.load_ns)
        statistics.add("loads_from_cache", cached)
        statistics.add("layers_computed", source == "load_computed")
        statistics.add("loads_finished")
        statistics.add("bytes_loaded", resident.nbytes)
        statistics.add("loads_after_eviction", again)
        statistics.add_duration("load", took_ns)

    def revived(self, resident: Resident) -> None:
        """Report that a retired segment is in service again, without a load."""
        self._publish_loaded(resident, 0, 0, ahead=False)

    def _publish_loaded(self, resident: Resident, load_ns: int, replaces: int, ahead: bool) -> bool:
        """Publish that a segment is in service; return whether it had been evicted for lack of memory."""
        again = self._history.take_eviction(resident.key, resident.version)
        self._log.publish(
            events.Loaded,
            self._id(resident.key.cell_id),
            resident.key.layer,
            resident.version,
            resident.nbytes,
            resident.points,
            load_ns,
            again,
            replaces,
            ahead,
        )
        return again

    def changed(self, cell_id: str, version: int) -> None:
        """Report that a load found a cell's file in another state than the catalogue knows."""
        self._log.publish(events.Changed, self._id(cell_id), version, "changed")

    def retired(self, resident: Resident, why: str) -> None:
        """Report that a segment left service, unless it was superseded: its successor's event is enough."""
        if why == "room":
            self._history.note_eviction(resident.key, resident.version)
        if why != "superseded":
            cell, layer = resident.key
            reason = "budget" if why == "room" else why
            log.debug("evicted", cell=cell, layer=layer, bytes=resident.nbytes, reason=reason)
            self.minutes.count("cells evicted", reason, resident.nbytes)
            self._log.publish(events.Evicted, self._id(cell), layer, resident.version, resident.nbytes, why)

    def failed(self, key: Key, failure: Failure, now_s: float) -> None:
        """Report that a load ended without a segment."""
        if failure.code in SPACE_CODES:
            self._pressure.note_refusal(self._id(key.cell_id), key.layer, failure.code, now_s)
        else:
            self._log.publish(
                events.Failed,
                self._id(key.cell_id),
                key.layer,
                failure.code,
                failure.message,
                failure.delay_s,
            )

    def retried(self, key: Key, failure: Failure) -> None:
        """Report that a cell that failed is about to be loaded again."""
        if failure.code not in SPACE_CODES:
            self._log.publish(events.Retried, self._id(key.cell_id), key.layer, failure.code)

    def refused_by_quota(self, key: Key, now_s: float) -> None:
        """Count and report a cell that would exceed its session's quota."""
        self._statistics.add("refused_quota")
        self._pressure.note_refusal(self._id(key.cell_id), key.layer, "quota", now_s)

    def prefetch_missed(self, session: Session, key: Key) -> None:
        """Count and report that a moving client has to wait for a cell, unless it waits already."""
        self._statistics.add(
            "prefetch_misses", self._misses.note_wait(session, self._id(key.cell_id), key.layer)
        )

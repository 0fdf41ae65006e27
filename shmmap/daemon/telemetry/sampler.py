# SPDX-License-Identifier: Apache-2.0
"""Periodic measurements: a few times a second, the daemon's state is written to the statistics.

A beat runs in the serving loop itself, so that a daemon that hangs stops beating; it takes several turns.
While nothing arrives beats are rare.
"""

from __future__ import annotations

import contextlib
import time
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sized
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.cache.holders import Share, Survey
from shmmap.daemon.events.log import EventLog
from shmmap.daemon.loading.scheduler import Scheduler
from shmmap.daemon.transport.sessions import Session, Sessions
from shmmap.daemon.turns import WatchedDescriptors
from shmmap.geometry import Area, Box, Circle
from shmmap.protocol.rows import ClientRow, Window
from shmmap.statistics.counters import REFUSALS, SPANS, WINDOWED
from shmmap.statistics.writer import StatisticsWriter

if TYPE_CHECKING:
    from shmmap.daemon.loading.link import Link
    from shmmap.daemon.map.published_origin import PublishedOrigin
    from shmmap.origin.remote.object_tier import ObjectCounts

BEAT_S: Final = 0.25
IDLE_BEAT_S: Final = 1.0
"""Interval of beats while the daemon is idle; it counts as hung after five seconds without one."""
IDLE_AFTER_S: Final = 2.0
"""Time without a ready descriptor and without loads after which the daemon is idle."""
EVENT_BEAT_S: Final = 1.0
"""Interval of publishing the last event's number, which reveals missed events."""
MAX_TURNS_OF_USED: Final = 4
"""Turns, at most, in which a beat checks the cells that clients were given."""
SAMPLE_S: Final = 1.0
"""Interval of sampling the counters for the last minutes."""


class RecentCounts:
    """Values of the counters `WINDOWED`, sampled once a second, to compute their growth over `SPANS`."""

    def __init__(self) -> None:
        length = int(max(SPANS.values()) / SAMPLE_S) + 2
        self._samples: deque[tuple[float, dict[str, int]]] = deque(maxlen=length)

    def look(self, values: Mapping[str, int], now_s: float) -> None:
        """Take a sample if the last one is old enough."""
        if not self._samples or now_s - self._samples[-1][0] >= SAMPLE_S:
            self._samples.append((now_s, {name: values[name] for name in WINDOWED}))

    def growth(self, values: Mapping[str, int], now_s: float) -> dict[str, int]:
        """Return the growth of each counter over each span, to a sample's precision, by gauge.

        If a span is longer than the stored samples, the growth is that since the first sample.
        """
        return {
            f"{name}_{span}": values[name] - old
            for span, seconds in SPANS.items()
            for name, old in self._at(now_s - seconds).items()
        }

    def _at(self, time_s: float) -> dict[str, int]:
        """Return the newest sample that is at least as old as ``time_s``, or else the oldest one."""
        found = bisect_right(self._samples, time_s, key=lambda sample: sample[0])
        return self._samples[max(0, found - 1)][1]


def client_row(session: Session, share: Share) -> ClientRow:
    """Return the row of a client, and of what it maps, for operators."""
    intent, peer = session.intent, session.peer
    return ClientRow(
        session.slot,
        peer.pid,
        peer.uid,
        peer.gid,
        session.client,
        session.command,
        len(session.held),
        session.held_bytes,
        session.requests,
        int(session.last_request_s * 1e9),
        (float(intent.x), float(intent.y)) if intent is not None else None,
        None if intent is None or intent.heading is None else float(intent.heading),
        _window(session.area) if session.area is not None else None,
        share.mapped_bytes,
        share.superseded,
        share.superseded_bytes,
    )


def _window(area: Area) -> Window:
    if isinstance(area, Box):
        half = (0.5 * (area.max_x - area.min_x), 0.5 * (area.max_y - area.min_y))
        return Window("box", *area.center, *half)
    return Window("circle" if isinstance(area, Circle) else "square", *area.center, area.radius, area.radius)


@dataclass(eq=False, slots=True)
class Sampler:
    """Periodic measurement, a few times a second, and writing of the statistics.

    Parameters
    ----------
    watched
        Descriptors of the loop; while none gets ready, the daemon is idle.
    waiting
        Collection of the requests that wait for loads; its length is measured.
    on_beat
        Called after each beat.
    """

    cache: CellCache
    survey: Survey
    scheduler: Scheduler
    statistics: StatisticsWriter
    event_log: EventLog
    sessions: Sessions
    watched: WatchedDescriptors
    waiting: Sized
    on_beat: Callable[[], None]
    _next_s: float = 0.0
    _wakes: int = -1
    _awake_s: float = 0.0  # of the last beat before which something had arrived
    _idle: bool = False
    _beating: Iterator[None] | None = None
    _recent: RecentCounts = field(default_factory=RecentCounts)
    _event_beat_s: float = float("-inf")
    _last_s: float = 0.0
    _outage_since_s: float | None = None

    @property
    def next_s(self) -> float:
        """Return when the next beat, or the next step of one, is due."""
        if self._beating is not None:
            return 0.0
        if self._idle and self.watched.wakes != self._wakes:
            self._idle = False
            self._next_s = self._last_s + BEAT_S
        return self._next_s

    def run_step(self, now_s: float) -> None:
        """Begin a beat, or continue the current one."""
        if self._beating is None:
            self._last_s, self._next_s = now_s, now_s + self._interval_s(now_s)
            self._beating = self._beat(now_s)
        beating, self._beating = self._beating, None
        with contextlib.suppress(StopIteration):
            next(beating)
            self._beating = beating

    def _interval_s(self, now_s: float) -> float:
        """Return the time from a beat to the next one."""
        if self.watched.wakes != self._wakes or len(self.scheduler.loads) or len(self.waiting):
            self._wakes, self._awake_s = self.watched.wakes, now_s
        self._idle = now_s >= self._awake_s + IDLE_AFTER_S
        return IDLE_BEAT_S if self._idle else BEAT_S

    def measure(self) -> None:
        """Update the gauges of memory, loads and the map."""
        self.cache.measure()
        set_value = self.statistics.set
        set_value("sessions", len(self.sessions))
        set_value("waiting_requests", len(self.waiting))
        set_value("workers", len(self.scheduler.pool))
        set_value("loaders_compiling", self.scheduler.pool.compiling)
        set_value("load_queue", len(self.scheduler.loads))
        set_value("unloadable", self.scheduler.loads.unloadable)
        set_value("events_published", self.event_log.last)

    def _look_around(self, now_s: float) -> None:
        """Sample the counters, and publish periodic reports and events."""
        values = self.statistics.values
        self._recent.look(values, now_s)
        values.update(self._recent.growth(values, now_s))
        self.cache.report(now_s)
        self._measure_prefetching(now_s)
        if now_s - self._event_beat_s >= EVENT_BEAT_S:
            self._event_beat_s = now_s
            self.event_log.beat()

    def _measure_prefetching(self, now_s: float) -> None:
        """Write what limits prefetching, and the outages of the map's storage.

        An outage counts from the start of its failed loads; its length is shown until the next outage.
        """
        prefetcher, statistics = self.scheduler.prefetcher, self.statistics
        health = prefetcher.health
        statistics.set("outage_tolerance_ns", int(prefetcher.outage_tolerance_s * 1e9))
        statistics.set("prefetch_budget_bytes", int(prefetcher.budget_bytes))
        statistics.set("prefetch_short", prefetcher.shortage(now_s))
        statistics.set("origin_out", int(health.is_out))
        if health.is_out and self._outage_since_s is None:
            self._outage_since_s = now_s - health.waited_s
            statistics.add("origin_outages")
            statistics.set("origin_out_since_unix_ns", time.time_ns() - int(health.waited_s * 1e9))
        if self._outage_since_s is not None:
            statistics.set("last_outage_ns", int((now_s - self._outage_since_s) * 1e9))
            if not health.is_out:
                self._outage_since_s = None
                statistics.set("origin_out_since_unix_ns", 0)

    def _beat(self, now_s: float) -> Iterator[None]:
        """Run one beat; each step takes some tenths of a millisecond at most."""
        statistics = self.statistics
        pause = () if self._idle else (None,)  # between steps in which there is hardly anything to do then
        if self.survey.idle:  # else it is run as a background task
            self.survey.step()
        yield
        self._look_around(now_s)
        yield from pause
        for _ in range(MAX_TURNS_OF_USED):
            more = self.cache.check_used(now_s)
            yield from pause
            if not more:
                break
        yield
        self.measure()
        yield from pause
        statistics.beat()
        yield
        statistics.restore(now_s)
        self.on_beat()


class PublishedGauges:
    """Statistics of a published map: its version, and the daemon's own reads.

    Loaders report their reads in the messages that end their loads.
    """

    def __init__(self, statistics: StatisticsWriter) -> None:
        self._statistics = statistics
        self._counts: ObjectCounts | None = None

    def look(self, origin: PublishedOrigin, link: Link | None) -> None:
        """Write the served version, the reads since the last call, and what the link is used for."""
        if link is not None:
            self._look_at(link)
        statistics, counts = self._statistics, origin.counts
        if counts != self._counts:
            statistics.add_objects_read(counts if self._counts is None else counts.since(self._counts))
            self._counts = counts
        served, taken = origin.in_service, origin.taken
        if served is not None:
            statistics.set("published_version", served.version)
            statistics.set("published_taken_unix_ns", int(served.taken_s * 1e9))
        if taken is not None:
            statistics.set("published_expires_unix_ns", int(taken.expires_s * 1e9))
            statistics.set("published_signed_unix_ns", int(taken.signed_s * 1e9))
        statistics.set("published_refused", origin.refused_version)
        statistics.set("published_refusal", REFUSALS.index(origin.refusal))

    def _look_at(self, link: Link) -> None:
        for cause, nbytes in link.received.items():
            self._statistics.set(f"link_{cause}_bytes", nbytes)
        self._statistics.set("link_rate_bytes", int(link.rate_bytes_s))
        self._statistics.set("link_under_way_bytes", link.under_way_bytes)

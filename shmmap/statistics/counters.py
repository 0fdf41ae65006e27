# SPDX-License-Identifier: Apache-2.0
"""Every counter and histogram of the daemon, described once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal, NamedTuple


class Counter(NamedTuple):
    """One number the daemon keeps.

    ``kind`` is ``counter`` for a number that only grows during one run of the daemon, ``gauge`` for a present
    amount, and ``histogram`` for a distribution of durations (`Histogram`).  ``unit`` is empty for plain
    counts.
    """

    name: str
    kind: Literal["counter", "gauge", "histogram"]
    unit: str
    help: str


SPANS: Final = {"10s": 10, "1min": 60, "10min": 600}
"""Time spans over which some counters are also summed, seconds, by suffix."""

WINDOWED: Final = {
    "hits": "Cells answered from memory",
    "misses": "Cells that had to be loaded first",
    "evictions": "Segments retired to make room",
    "loads_after_eviction": "Loads of cells that had been evicted to make room",
    "refused_over_budget": "Cells refused because the budget is full",
    "prefetch_misses": "Cells that a moving client requested and had to wait for",
}
"""Counters that are also shown for the last 10 s, 1 min and 10 min, to judge the present state."""

TURN_KINDS: Final = {
    "clients": "clients were read",
    "requests": "a request was served, or the first part of a large one",
    "answers": "another part of a large request was served, or one that waited was answered",
    "loaders": "a loader was read, and what it loaded published",
    "memory": "loads were handed out, room made and memory freed",
    "usage": "the kernel was asked which processes use segments",
    "statistics": "the statistics were written",
    "map": "another state of the map was taken over",
}
"""Kinds of turns of the serving loop, by the work that took most of the turn."""

REFUSALS: Final = ("", "unsigned", "older", "expired", "altered", "foreign_root", "other")
"""Reasons for refusing the offered version of a published map, by the value of ``published_refusal``."""

OBJECTS_READ: Final = {
    "objects_from_disk": ("", "Objects read from the disk cache instead of the store"),
    "bytes_from_disk": ("bytes", "Bytes of objects read from the disk cache"),
    "objects_fetched": ("", "Objects fetched from the store, index pages included"),
    "bytes_fetched": ("bytes", "Bytes of objects fetched from the store"),
    "objects_damaged_on_disk": ("", "Objects found damaged in the disk cache, and removed"),
    "objects_damaged_in_store": ("", "Objects from the store that did not match their name's hash"),
    "fetches_failed": ("", "Times that an object could not be fetched from the store"),
}
"""Counters of objects that the daemon of a published map and its loaders read: unit and help."""

LINK_CAUSES: Final = {
    "demand": "Bytes that came over the link for cells that clients asked for",
    "ahead": "Bytes that came over the link for cells that no client had asked for yet",
    "index": "Bytes that came over the link for the list of cells",
}
"""What the link to a published map's origin is used for; the counters are ``link_CAUSE_bytes``."""

_PUBLISHED: Final = (
    *(Counter(name, "counter", unit, text) for name, (unit, text) in OBJECTS_READ.items()),
    *(Counter(f"link_{cause}_bytes", "counter", "bytes", text) for cause, text in LINK_CAUSES.items()),
    Counter(
        "link_rate_bytes", "gauge", "bytes", "Greatest rate of the link lately, a second; 0: not known yet"
    ),
    Counter("link_under_way_bytes", "gauge", "bytes", "Bytes that have been asked for over the link"),
    Counter("published_version", "gauge", "", "Number of the published version that is served; 0: files"),
    Counter("published_refused", "gauge", "", "Number of a version that is offered and refused; 0: none"),
    Counter("published_taken_unix_ns", "gauge", "ns", "When the version served was taken, wall clock"),
    Counter("published_expires_unix_ns", "gauge", "ns", "When its signature expires; 0: it is not signed"),
    Counter("published_signed_unix_ns", "gauge", "ns", "When that was signed, wall clock; 0: it is not"),
    Counter(
        "published_refusal",
        "gauge",
        "",
        "Why an offer is not taken: 1 unsigned, 2 older, 3 expired, 4 altered, 5 foreign, 6 other",
    ),
    Counter("map_pages", "gauge", "", "Pages of the list of cells"),
    Counter("map_pages_known", "gauge", "", "Pages of it that are here"),
    Counter("disk_ahead", "gauge", "", "1 while what lies ahead and has no room in memory is on the disk"),
)

PUBLISHED: Final = frozenset(counter.name for counter in _PUBLISHED)
"""Counters that apply only to published maps, not to maps from files."""

COUNTERS: Final = (
    Counter("requests", "counter", "", "Requests received, well-formed or not"),
    Counter("replies", "counter", "", "Replies sent, error replies included"),
    Counter("errors_returned", "counter", "", "Requests refused as a whole"),
    Counter("bytes_received", "counter", "bytes", "Request bytes received"),
    Counter("bytes_sent", "counter", "bytes", "Reply bytes sent"),
    Counter("handles_sent", "counter", "", "Segment handles sent in replies"),
    Counter("starting", "gauge", "", "1 while the daemon gets ready and does not listen yet"),
    Counter("sessions", "gauge", "", "Client sessions that are alive"),
    Counter("sessions_opened", "counter", "", "Client sessions opened"),
    Counter("waiting_requests", "gauge", "", "Requests that wait for cells to be loaded"),
    Counter("loads_started", "counter", "", "Loads handed to a worker"),
    Counter("loads_finished", "counter", "", "Loads that ended with a published segment"),
    Counter("loads_failed", "counter", "", "Loads that ended with an error"),
    Counter("unloadable", "gauge", "", "Cells' layers that could not be loaded when last tried"),
    Counter("loads_timed_out", "counter", "", "Loads stopped at their deadline"),
    Counter("bytes_loaded", "counter", "bytes", "Segment bytes published"),
    Counter("workers", "gauge", "", "Loader processes that are alive"),
    Counter("loaders_compiling", "gauge", "", "Loader processes that compile kernels, once for each version"),
    Counter("worker_crashes", "counter", "", "Loader processes that ended unexpectedly"),
    Counter("load_queue", "gauge", "", "Loads waiting for a worker"),
    Counter("cells_resident", "gauge", "", "Segments that can be handed out"),
    Counter("stale_cells", "gauge", "", "Resident segments whose successor could not be loaded yet"),
    Counter("bytes_resident", "gauge", "bytes", "Memory of segments that can be handed out"),
    Counter("zombies", "gauge", "", "Retired segments that are still mapped"),
    Counter("bytes_zombie", "gauge", "bytes", "Memory of retired segments that are still mapped"),
    Counter("bytes_reserved", "gauge", "bytes", "Memory set aside for loads in progress"),
    Counter("bytes_pinned", "gauge", "bytes", "Memory that is mapped, as last probed"),
    Counter("bytes_statistics", "gauge", "bytes", "Memory of this statistics segment"),
    Counter("budget_bytes", "gauge", "bytes", "Most memory the segments may occupy"),
    Counter("evictions", "counter", "", "Segments retired to make room"),
    Counter("refused_over_budget", "counter", "", "Cells refused because the budget is full"),
    Counter("refused_quota", "counter", "", "Cells refused because the session's quota is full"),
    Counter("hits", "counter", "", "Cells answered from memory"),
    Counter("misses", "counter", "", "Cells that had to be loaded first"),
    Counter("reloads", "counter", "", "Times the map's catalogue was read again"),
    Counter("adopted", "counter", "", "Segments of the previous run taken over at the start"),
    Counter("adoptions_failed", "counter", "", "Segments taken over that did not match their checksums"),
    Counter(
        "pin_source",
        "gauge",
        "",
        "How the use of a segment is known: 0 leases, 1 locks of clients, 2 what sessions say",
    ),
    Counter("map_cells", "gauge", "", "Cells in the map's catalogue"),
    Counter("map_cells_known", "gauge", "", "Cells of it that are known, where the list comes in pages"),
    Counter("reloads_failed", "counter", "", "Times the map's catalogue could not be read again"),
    Counter("last_reload_unix_ns", "gauge", "ns", "When the catalogue was last read, wall clock"),
    Counter("last_reload_failed", "gauge", "", "1 if the last attempt to read the catalogue again failed"),
    Counter("loads_after_eviction", "counter", "", WINDOWED["loads_after_eviction"]),
    Counter("segments_pinned", "gauge", "", "Segments that are mapped, as last probed"),
    Counter("layers_computed", "counter", "", "Loads that computed a layer"),
    Counter("loads_from_cache", "counter", "", "Loads that found their layer in the disk cache"),
    Counter("events_published", "counter", "", "Events of this run of the daemon"),
    Counter("map_problems", "gauge", "", "Problems found when the map was last read; its log names them"),
    Counter("defects", "counter", "", "Exceptions that the daemon survived; its log has their tracebacks"),
    Counter("prefetch_misses", "counter", "", WINDOWED["prefetch_misses"]),
    Counter("prefetch_started", "counter", "", "Loads begun before a client requested the cell"),
    Counter("prefetch_used", "counter", "", "Prefetched segments that a client then requested"),
    Counter("prefetch_in_vain", "counter", "", "Prefetched segments that left memory unrequested"),
    Counter("prefetch_overtaken", "counter", "", "Cells requested while they were being prefetched"),
    Counter("bytes_prefetched", "gauge", "bytes", "Memory of what was prefetched and not requested yet"),
    Counter(
        "bytes_used",
        "counter",
        "bytes",
        "Segment bytes handed out for the first time; bytes_loaded by this: over-fetch",
    ),
    Counter(
        "prefetch_budget_bytes", "gauge", "bytes", "Most that bytes_prefetched may come to; 0: never ahead"
    ),
    Counter(
        "prefetch_short",
        "gauge",
        "",
        "What keeps cells from being fetched ahead: 0 nothing, 1 their share is full, 2 the budget is",
    ),
    Counter(
        "outage_tolerance_ns", "gauge", "ns", "Outage of the map's storage that prefetching bridges (setting)"
    ),
    Counter("origin_out", "gauge", "", "1 while no load succeeds: the map's files are out of reach"),
    Counter("origin_outages", "counter", "", "Times that no load succeeded"),
    Counter("last_outage_ns", "gauge", "ns", "How long the last time lasted, or the present one does"),
    Counter("live_restarts", "counter", "", "Times the process that keeps live maps ended, and restarted"),
    Counter(
        "cells_outside_box", "gauge", "", "Cells loaded with points outside their box; the log names them"
    ),
    Counter(
        "sockets_missing", "gauge", "", "Sockets whose files others removed, and that cannot be made again"
    ),
    Counter("package_replaced", "gauge", "", "1 if shmmap was replaced under the daemon: restart it"),
    *(
        Counter(f"longest_turn_{kind}_ns", "gauge", "ns", f"Longest turn in which {text}")
        for kind, text in TURN_KINDS.items()
    ),
    *(
        Counter(f"{name}_{span}", "gauge", "", f"{text}, in the last {span}")
        for name, text in WINDOWED.items()
        for span in SPANS
    ),
    Counter("layers_prepared", "counter", "", "Layers computed into the disk cache before clients asked"),
    Counter("prepare_cells", "gauge", "", "Cells' layers that the setting prepare names"),
    Counter("prepare_done", "gauge", "", "Cells' layers of it that are in the disk cache"),
    Counter("prepare_failed", "gauge", "", "Cells' layers of it that cannot be made; the log names them"),
    Counter("prepare_retries", "gauge", "", "Of these, those whose loader was killed, to be tried again"),
    Counter(
        "prepare_short",
        "gauge",
        "",
        "What keeps layers from being prepared: 0 nothing, 1 cache_size is too small, 2 no writing",
    ),
    Counter("origin_out_since_unix_ns", "gauge", "ns", "Since when origin_out is 1, wall clock; else 0"),
    *_PUBLISHED,
)

COUNTER_NAMES: Final = tuple(counter.name for counter in COUNTERS)

HISTOGRAMS: Final = (
    Counter("request", "histogram", "ns", "Serving loop's time for one request, waiting for loads left out"),
    Counter("turn", "histogram", "ns", "Processor time of a turn of the serving loop: others wait so long"),
    Counter("wait", "histogram", "ns", "From a request that had to wait for loads to its answer"),
    Counter("load", "histogram", "ns", "From handing a load to a worker to its published segment"),
    Counter("load_points", "histogram", "ns", "A loader's own time for points read from the map's file"),
    Counter("load_computed", "histogram", "ns", "A loader's own time for a layer that it computed"),
    Counter("load_cached", "histogram", "ns", "A loader's own time for a layer out of the disk cache"),
)


FIRST_EXPONENT: Final = 10
LAST_EXPONENT: Final = 42
STEPS: Final = 4
BUCKETS: Final = 2 + STEPS * (LAST_EXPONENT - FIRST_EXPONENT)


def bucket_of(duration_ns: int) -> int:
    """Return the index of the bucket that counts a duration."""
    exponent = duration_ns.bit_length() - 1
    if exponent < FIRST_EXPONENT or duration_ns < 0:
        return 0
    if exponent >= LAST_EXPONENT:
        return BUCKETS - 1
    # the two bits below the leading bit select the quarter of the octave
    return 4 * (exponent - FIRST_EXPONENT) + (duration_ns >> (exponent - 2)) - 3


def lower_bound_ns(bucket: int) -> int:
    """Return the shortest duration that a bucket counts, which is the end of the previous bucket."""
    if bucket <= 0:
        return 0
    octave, step = divmod(bucket - 1, STEPS)
    return (STEPS + step) << (FIRST_EXPONENT + octave - 2)


class Histogram(NamedTuple):
    """Distribution of durations since the daemon's start, in buckets that any reader can compute.

    An octave has four buckets, from 1 us to 73 min.  Bucket 0 counts durations below 2^10 ns.  Bucket ``1 + 4
    (e - 10) + s`` counts durations in ``[2^e (1 + s/4), 2^e (1 + (s + 1)/4))`` ns, for e in 10 … 41 and s in
    0 … 3.  The last bucket counts durations of 2^42 ns and longer.  A bucket is at most a quarter wider than
    its lower bound, and finding it takes no logarithm.

    Attributes
    ----------
    sum_ns
        Sum of all durations, ns.
    counts
        Number of durations in each bucket.
    """

    sum_ns: int = 0
    counts: tuple[int, ...] = (0,) * BUCKETS

    @property
    def total(self) -> int:
        """Number of durations."""
        return sum(self.counts)

    def quantile_s(self, share: float) -> float | None:
        """Return the duration in seconds that a ``share`` of all does not exceed; None if there are none.

        Durations are assumed to be spread evenly within a bucket, so the result is accurate to about an
        eighth.  For the last bucket only the lower bound is known.
        """
        total = self.total
        if not total:
            return None
        wanted = share * total
        before = 0
        for bucket, count in enumerate(self.counts):
            if count and before + count >= wanted:
                low = lower_bound_ns(bucket)
                high = lower_bound_ns(bucket + 1) if bucket + 1 < len(self.counts) else low
                return (low + (high - low) * max(wanted - before, 0.0) / count) * 1e-9
            before += count
        return lower_bound_ns(len(self.counts) - 1) * 1e-9

    def since(self, earlier: Histogram) -> Histogram:
        """Return the durations counted after ``earlier``, a previous state of the same histogram."""
        counts = tuple(new - old for new, old in zip(self.counts, earlier.counts, strict=True))
        return Histogram(self.sum_ns - earlier.sum_ns, counts)

    @classmethod
    def of(cls, values: Sequence[int]) -> Histogram:
        """Make a histogram from its sum and counts in a segment."""
        return cls(values[0], tuple(values[1:]))

# SPDX-License-Identifier: Apache-2.0
"""Every counter of the daemon, described once."""

from __future__ import annotations

from typing import Final, Literal, NamedTuple

__all__ = ["COUNTERS", "COUNTER_NAMES", "Counter"]


class Counter(NamedTuple):
    """One number the daemon keeps.

    ``kind`` is ``counter`` for what only grows during one life of the daemon and ``gauge`` for a
    present amount.  ``unit`` is empty for plain counts.
    """

    name: str
    kind: Literal["counter", "gauge"]
    unit: str
    help: str


COUNTERS: Final = (
    Counter("requests", "counter", "", "Requests received, well-formed or not"),
    Counter("replies", "counter", "", "Replies sent, error replies included"),
    Counter("errors_returned", "counter", "", "Requests refused as a whole"),
    Counter("bytes_received", "counter", "bytes", "Request bytes received"),
    Counter("bytes_sent", "counter", "bytes", "Reply bytes sent"),
    Counter("handles_sent", "counter", "", "Segment handles sent in replies"),
    Counter("sessions", "gauge", "", "Client sessions that are alive"),
    Counter("sessions_opened", "counter", "", "Client sessions opened"),
    Counter("waiting_requests", "gauge", "", "Requests that wait for cells to be loaded"),
    Counter("loads_started", "counter", "", "Loads handed to a worker"),
    Counter("loads_finished", "counter", "", "Loads that ended with a published segment"),
    Counter("loads_failed", "counter", "", "Loads that ended with an error"),
    Counter("loads_timed_out", "counter", "", "Loads stopped at their deadline"),
    Counter("bytes_loaded", "counter", "bytes", "Segment bytes published"),
    Counter("workers", "gauge", "", "Loader processes that are alive"),
    Counter("worker_crashes", "counter", "", "Loader processes that ended unexpectedly"),
    Counter("load_queue", "gauge", "", "Loads waiting for a worker"),
    Counter("cells_resident", "gauge", "", "Segments that can be handed out"),
    Counter("stale_cells", "gauge", "", "Resident segments whose successor could not be loaded yet"),
    Counter("bytes_resident", "gauge", "bytes", "Memory of segments that can be handed out"),
    Counter("zombies", "gauge", "", "Retired segments that somebody still maps"),
    Counter("bytes_zombie", "gauge", "bytes", "Memory of retired segments that somebody still maps"),
    Counter("bytes_reserved", "gauge", "bytes", "Memory set aside for loads in progress"),
    Counter("bytes_pinned", "gauge", "bytes", "Memory somebody maps, as last probed"),
    Counter("bytes_statistics", "gauge", "bytes", "Memory of this statistics segment"),
    Counter("budget_bytes", "gauge", "bytes", "Most memory the segments may occupy"),
    Counter("evictions", "counter", "", "Segments retired to make room or on request"),
    Counter("refused_over_budget", "counter", "", "Cells refused because the budget is full"),
    Counter("refused_quota", "counter", "", "Cells refused because the session's quota is full"),
    Counter("hits", "counter", "", "Cells answered from memory"),
    Counter("misses", "counter", "", "Cells that had to be loaded first"),
    Counter("reloads", "counter", "", "Times the map's catalogue was read again"),
    Counter("adopted", "counter", "", "Segments of an earlier life of the daemon taken over at its start"),
    Counter("adoptions_failed", "counter", "", "Segments taken over that did not match their checksums"),
    Counter(
        "pin_source",
        "gauge",
        "",
        "How the use of a segment is known: 0 leases, 1 locks of clients, 2 what sessions say",
    ),
    Counter("map_cells", "gauge", "", "Cells in the map's catalogue"),
)

COUNTER_NAMES: Final = tuple(counter.name for counter in COUNTERS)

# SPDX-License-Identifier: Apache-2.0
"""JSON output of ``shmmap status``, ``top`` and ``health``; imported only for ``--json``."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Annotated, Literal, TypeAlias, Union, get_args

import msgspec

from shmmap.cli.json_output import Box, Client, Hex, Holder, LiveMap, Segment, hexed
from shmmap.cli.screens.status_parts import over_fetch, uptime_s
from shmmap.cli.screens.top_screen import budget_parts
from shmmap.cli.verbs.look.tail import HEX_FIELDS
from shmmap.doctor.verdicts import Finding, cache_verdict
from shmmap.protocol.messages import ShownCell
from shmmap.statistics.counters import LINK_CAUSES, SPANS
from shmmap.statistics.identity import DaemonIdentity
from shmmap.statistics.reader import Snapshot

State: TypeAlias = Annotated[
    str,
    msgspec.Meta(
        description="healthy, starting (it does not listen yet), stopped (paused by a signal or a debugger),"
        " hung or dead; of health also unreachable (its socket was removed)"
    ),
]


class Prefetching(msgspec.Struct):
    """Counters of cells fetched before clients request them."""

    outage_tolerance_s: Annotated[float, msgspec.Meta(description="the setting")]
    origin_out: Annotated[bool, msgspec.Meta(description="no load succeeds")]
    last_outage_s: float
    prefetch_misses: Annotated[int, msgspec.Meta(description="cells that moving clients waited for")]
    prefetch_started: int
    prefetch_used: int
    prefetch_in_vain: int
    prefetch_overtaken: int
    bytes_prefetched: int
    over_fetch: Annotated[
        float | None, msgspec.Meta(description="bytes loaded by bytes handed out at least once")
    ]

    @classmethod
    def of(cls, counters: Mapping[str, int]) -> Prefetching:
        """Return the setting, the storage's outages and the counters of prefetching."""
        ratio = over_fetch(counters)
        return cls(
            counters.get("outage_tolerance_ns", 0) * 1e-9,
            bool(counters.get("origin_out", 0)),
            round(counters.get("last_outage_ns", 0) * 1e-9, 3),
            counters.get("prefetch_misses", 0),
            counters.get("prefetch_started", 0),
            counters.get("prefetch_used", 0),
            counters.get("prefetch_in_vain", 0),
            counters.get("prefetch_overtaken", 0),
            counters.get("bytes_prefetched", 0),
            None if ratio is None else round(ratio, 4),
        )


class Published(msgspec.Struct):
    """The published map that the daemon serves; times are Unix seconds."""

    version: int
    refused: Annotated[int | None, msgspec.Meta(description="number of an offered version that is refused")]
    taken_unix_s: float | None
    expires_unix_s: Annotated[float | None, msgspec.Meta(description="null: it is not signed")]
    offline_since_unix_s: float | None
    cells: int
    cells_known: int
    pages: Annotated[int, msgspec.Meta(description="of the list of cells")]
    pages_known: int
    objects_from_disk: int
    bytes_from_disk: int
    objects_fetched: int
    bytes_fetched: int
    objects_damaged_on_disk: int
    objects_damaged_in_store: int
    fetches_failed: int
    link_bytes: Annotated[dict[str, int], msgspec.Meta(description="what came over the link, by cause")]
    link_bytes_per_second: Annotated[int | None, msgspec.Meta(description="greatest rate of the link lately")]

    @classmethod
    def of(cls, counters: Mapping[str, int]) -> Published | None:
        """Return the JSON form of a published map's counters; None if the map is files."""
        if not counters.get("published_version"):
            return None
        taken, expires, out = (
            counters[f"{name}_unix_ns"] * 1e-9 or None
            for name in ("published_taken", "published_expires", "origin_out_since")
        )
        return cls(
            counters["published_version"],
            counters["published_refused"] or None,
            taken,
            expires,
            out,
            counters["map_cells"],
            counters["map_cells_known"],
            counters["map_pages"],
            counters["map_pages_known"],
            counters["objects_from_disk"],
            counters["bytes_from_disk"],
            counters["objects_fetched"],
            counters["bytes_fetched"],
            counters["objects_damaged_on_disk"],
            counters["objects_damaged_in_store"],
            counters["fetches_failed"],
            {cause: counters.get(f"link_{cause}_bytes", 0) for cause in LINK_CAUSES},
            counters.get("link_rate_bytes", 0) or None,
        )


class Status(msgspec.Struct):
    """The state of a daemon."""

    state: State
    beat_age_s: Annotated[float, msgspec.Meta(description="since its last heartbeat")]
    pid: int
    uptime_s: float
    instance: str
    endpoint: str
    epoch: Hex
    version: str
    map_path: str
    map_version: Hex
    frame_id: str
    shm_dir: str
    counters: Annotated[dict[str, int], msgspec.Meta(description="as in `shmmap metrics`")]
    ahead: Prefetching
    published: Annotated[Published | None, msgspec.Meta(description="null where the map is files")]
    live: list[LiveMap]

    @classmethod
    def of(cls, found: Snapshot, identity: DaemonIdentity) -> Status:
        """Return the state of a daemon."""
        return cls(
            found.state,
            round(found.beat_age_s, 6),
            identity.pid,
            round(uptime_s(identity), 3),
            identity.instance,
            identity.endpoint,
            hexed(identity.epoch),
            identity.library_version,
            identity.map_path,
            hexed(identity.map_version),
            identity.frame_id,
            identity.shm_dir,
            found.counters,
            Prefetching.of(found.counters),
            Published.of(found.counters),
            [LiveMap.of(row) for row in found.live],
        )


class Latency(msgspec.Struct):
    """Quantiles in seconds, null without measurements."""

    p50: float | None
    p99: float | None
    count: int


class Top(msgspec.Struct):
    """Memory, latency and clients of a daemon."""

    state: State
    beat_age_s: float
    memory: Annotated[
        dict[str, int],
        msgspec.Meta(
            description="bytes: in_use (mapped by clients), idle, retired, loading, statistics, free"
        ),
    ]
    hit_ratio: Annotated[dict[str, float | None], msgspec.Meta(description="0 to 1, by span")]
    cache_too_small: bool
    cache: Annotated[str, msgspec.Meta(description="why it is")]
    hint: str
    ahead: Prefetching
    published: Published | None
    latency_s: Annotated[
        dict[str, Latency],
        msgspec.Meta(
            description="request, wait, load, turn (of the daemon's loop), and a loader's own time:"
            " load_points from the map's files, load_computed, load_cached from the disk cache"
        ),
    ]
    load_queue: int
    waiting_requests: int
    evictions: Annotated[int, msgspec.Meta(description="for lack of room")]
    refused_over_budget: int
    refused_quota: int
    live: list[LiveMap]
    clients: list[Client]

    @classmethod
    def of(cls, found: Snapshot) -> Top:
        """Return memory, latency and clients of a daemon."""
        count = found.counters
        verdict = cache_verdict(count)
        ratios = {}
        for span in SPANS:
            hits, requested = count[f"hits_{span}"], count[f"hits_{span}"] + count[f"misses_{span}"]
            ratios[span] = hits / requested if requested else None
        return cls(
            found.state,
            round(found.beat_age_s, 6),
            budget_parts(count),
            ratios,
            verdict.too_small,
            verdict.why,
            verdict.hint,
            Prefetching.of(count),
            Published.of(count),
            {
                name: Latency(h.quantile_s(0.5), h.quantile_s(0.99), h.total)
                for name, h in found.histograms.items()
            },
            count["load_queue"],
            count["waiting_requests"],
            count["evictions"],
            count["refused_over_budget"],
            count["refused_quota"],
            [LiveMap.of(row) for row in found.live],
            [Client.of(client, found.beat_monotonic_ns) for client in found.clients or ()],
        )


class Health(msgspec.Struct):
    """Whether a daemon is healthy."""

    state: State
    beat_age_s: float
    pid: int
    instance: str
    defects: Annotated[int, msgspec.Meta(description="exceptions that it survived; its log has them")]
    troubles: Annotated[list[str], msgspec.Meta(description="what --strict counts")]


class Listed(msgspec.Struct):
    """The state of a daemon, and its segments."""

    state: str
    epoch: Hex
    not_listed: Annotated[int, msgspec.Meta(description="0: all segments are listed")]
    cells: list[Segment]


class Shown(msgspec.Struct):
    """Everything about one cell."""

    id: str
    version: Hex
    box: Box
    z: Annotated[
        tuple[float, float] | None, msgspec.Meta(description="min and max; null before the first load")
    ]
    source_bytes: int
    loading: Annotated[list[str], msgspec.Meta(description="layers")]
    pinned: Annotated[list[str], msgspec.Meta(description="layers that an operator keeps")]
    failure: Annotated[str, msgspec.Meta(description="the last one that still stands")]
    segments: list[Segment]

    @classmethod
    def of(cls, cell: ShownCell) -> Shown:
        """Return the JSON form of a cell."""
        segments, now_ns = [], time.monotonic_ns()
        for row in cell.segments:
            segments.append(Segment.whole(row, now_ns))
            segments[-1].holders = [Holder.of(holder) for holder in row.holders]
        return cls(
            cell.id,
            hexed(cell.version),
            (cell.min_x, cell.min_y, cell.max_x, cell.max_y),
            None if cell.z_min is None or cell.z_max is None else (cell.z_min, cell.z_max),
            cell.source_bytes,
            list(cell.loading),
            list(cell.pinned),
            cell.failure,
            segments,
        )


class Clients(msgspec.Struct):
    """The clients of a daemon, including this program."""

    clients: list[Client]
    unknown_holders: Annotated[int, msgspec.Meta(description="segments mapped by unidentified processes")]
    unknown_bytes: int


class Diagnosis(msgspec.Struct):
    """All findings of the doctor."""

    worst: Literal["ok", "warn", "fail"]
    findings: list[Finding]


def json_events() -> object:
    """Return the types of the lines that ``--json`` prints: the protocol's events, and lost events."""
    from shmmap.client.event_stream import MissedEvents
    from shmmap.protocol.events import Event

    kinds = []
    for kind in (*get_args(Event), MissedEvents):
        fields = [
            ("time", float)
            if field.name == "unix_ns"
            else (field.name, Hex if field.name in HEX_FIELDS else field.type)
            for field in msgspec.structs.fields(kind)
        ]
        tag = kind.__struct_config__.tag or "missed"
        kinds.append(msgspec.defstruct(kind.__name__, fields, tag_field="event", tag=tag))
    return Union[tuple(kinds)]  # noqa: UP007


class Viewed(msgspec.Struct):
    """A picture of points."""

    image: str
    width: int
    height: int
    bytes: int
    points: Annotated[int, msgspec.Meta(description="points in the picture")]
    parts: Annotated[int, msgspec.Meta(description="cells, files or chunks that were read")]
    box: Annotated[list[float], msgspec.Meta(description="min_x, min_y, max_x, max_y shown, metres")]
    metres_per_pixel: float
    by: str
    low: Annotated[float, msgspec.Meta(description="value at the start of the colours")]
    high: Annotated[float, msgspec.Meta(description="value at their end")]

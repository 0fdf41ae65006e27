# SPDX-License-Identifier: Apache-2.0
"""What ``shmmap top`` shows, as lines of styled text: the same on a terminal and in a pipe."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final, TypeAlias

from shmmap.cli.screens.output import format_bytes, format_duration
from shmmap.doctor.cache_size import cache_verdict

if TYPE_CHECKING:
    from shmmap.statistics.client_rows import ClientRow
    from shmmap.statistics.histogram import Histogram
    from shmmap.statistics.identity import DaemonIdentity
    from shmmap.statistics.reader import Snapshot

__all__ = ["Line", "budget_parts", "screen"]

Line: TypeAlias = list[tuple[str, str]]  # (text, style) pieces

LABEL: Final = 12
SPAN_TITLES: Final = (("10s", "10 s"), ("1min", "1 min"), ("10min", "10 min"))
_STATE_STYLES: Final = {
    "healthy": "bold green",
    "stopped": "bold yellow",
    "hung": "bold red",
    "dead": "bold red",
}
_PARTS: Final = (
    # part, what it is called, glyph, style
    ("pinned", "in use", "█", "cyan"),
    ("idle", "idle", "▓", "green"),
    ("zombie", "retired", "▒", "yellow"),
    ("reserved", "reserved", "░", "magenta"),
    ("free", "free", "·", "bright_black"),
)


def budget_parts(counters: dict[str, int]) -> dict[str, int]:
    """Split the budget: bytes in use and idle (both can be handed out), retired, reserved, free.

    Reserved is what loads under way and the statistics themselves take.
    """
    resident, zombie = counters["bytes_resident"], counters["bytes_zombie"]
    # retired segments are there only because somebody maps them
    pinned = min(max(counters["bytes_pinned"] - zombie, 0), resident)
    parts = {
        "pinned": pinned,
        "idle": resident - pinned,
        "zombie": zombie,
        "reserved": counters["bytes_reserved"] + counters["bytes_statistics"],
    }
    parts["free"] = max(counters["budget_bytes"] - sum(parts.values()), 0)
    return parts


def screen(
    found: Snapshot,
    identity: DaemonIdentity,
    *,
    width: int,
    max_clients: int,
    earlier: Snapshot | None = None,
) -> list[Line]:
    """Return the lines.

    Parameters
    ----------
    width
        Columns of the terminal.
    max_clients
        Rows there are for clients.
    earlier
        A snapshot of some seconds ago; latencies are of the time since, without it since the start.
    """
    counters = found.counters
    lines = [_title(found, identity), _labelled("map", [(_map(identity, counters), "")]), []]
    lines += _budget(counters, width)
    lines.append([])
    lines.append(_labelled("hits", _hits(counters)))
    verdict = cache_verdict(counters)
    cache = ("TOO SMALL", "bold red") if verdict.too_small else ("large enough", "green")
    lines.append(_labelled("cache", [cache, (f": {verdict.why}", "")]))
    if verdict.hint:
        lines.append(_labelled("", [(verdict.hint, "")]))
    lines += _latencies(found, earlier)
    lines.append(_labelled("loads", _loads(counters)))
    lines.append(_labelled("pressure", _pressure(counters)))
    lines.append([])
    lines += _clients(found.clients, counters["sessions"], found.beat_monotonic_ns, width, max_clients)
    return lines


def _labelled(label: str, pieces: Line) -> Line:
    return [(label.ljust(LABEL), "bold"), *pieces]


def _title(found: Snapshot, identity: DaemonIdentity) -> Line:
    uptime_s = max(time.time() - identity.started_unix_ns * 1e-9, 0.0)
    told = {
        "healthy": f"  up {format_duration(uptime_s)}",
        "stopped": f"  no heartbeat for {format_duration(found.beat_age_s)}: `kill -CONT {identity.pid}`",
        "hung": f"  no heartbeat for {format_duration(found.beat_age_s)}",
        "dead": "  crashed or was killed; these are its last figures",
    }.get(found.state, "")
    return [
        ("shmmap ", "bold"),
        (identity.instance, "bold"),
        (f"  pid {identity.pid}  ", ""),
        (
            found.state.upper() if found.state != "healthy" else "healthy",
            _STATE_STYLES.get(found.state, "bold red"),
        ),
        (told, ""),
    ]


def _map(identity: DaemonIdentity, counters: dict[str, int]) -> str:
    read_s = max(time.time() - counters.get("last_reload_unix_ns", 0) * 1e-9, 0.0)
    failed = ", LAST RELOAD FAILED" if counters.get("last_reload_failed") else ""
    cells = f"{counters['map_cells']:,} cells"
    return f"{identity.map_path}, {cells}, read {format_duration(read_s)} ago{failed}"


def _budget(counters: dict[str, int], width: int) -> list[Line]:
    parts = budget_parts(counters)
    total = max(sum(parts.values()), 1)
    room = max(width - LABEL - 2, 20)
    bar: Line = []
    used = 0
    for index, (name, _, glyph, style) in enumerate(_PARTS):
        cells = room - used if index == len(_PARTS) - 1 else round(room * parts[name] / total)
        if parts[name] and not cells:
            cells = 1  # what there is can be seen
        cells = min(cells, room - used)
        used += cells
        bar.append((glyph * cells, style))
    legend: Line = []
    for name, title, glyph, style in _PARTS:
        legend += [(glyph, style), (f" {title} {format_bytes(parts[name])}   ", "")]
    budget = format_bytes(counters["budget_bytes"])
    return [_labelled("budget", [(budget, "")]), [(" " * LABEL, ""), *bar], [(" " * LABEL, ""), *legend]]


def _hits(counters: dict[str, int]) -> Line:
    pieces: Line = []
    for suffix, title in SPAN_TITLES:
        hits, misses = counters.get(f"hits_{suffix}", 0), counters.get(f"misses_{suffix}", 0)
        ratio = f"{100 * hits / (hits + misses):.1f} %" if hits + misses else "–"
        pieces.append((f"{title}: {ratio}   ", ""))
    total = counters["hits"] + counters["misses"]
    pieces.append((f"of {total:,} cells asked for since the start", "bright_black"))
    return pieces


def _latencies(found: Snapshot, earlier: Snapshot | None) -> list[Line]:
    lines = []
    titles = (("request", "requests"), ("wait", "waits"), ("load", "cell loads"))
    for name, title in titles:
        histogram: Histogram | None = found.histograms.get(name)
        if histogram is None:
            continue
        since = "since the start"
        if earlier is not None and earlier.identity == found.identity and name in earlier.histograms:
            recent = histogram.since(earlier.histograms[name])
            if recent.total:
                span_s = (found.beat_monotonic_ns - earlier.beat_monotonic_ns) * 1e-9
                histogram, since = recent, f"in the last {format_duration(span_s)}"
        lines.append(_labelled(title, [(_quantiles(histogram), ""), (since, "bright_black")]))
    return lines


def _quantiles(histogram: Histogram) -> str:
    median, slow = histogram.quantile_s(0.5), histogram.quantile_s(0.99)
    if median is None or slow is None:
        return "none yet "
    return f"p50 {format_duration(median)}   p99 {format_duration(slow)}   {histogram.total:,} "


def _loads(counters: dict[str, int]) -> Line:
    pieces: Line = [
        (f"queue {counters['load_queue']:,}   ", ""),
        (f"waiting requests {counters['waiting_requests']:,}   ", ""),
        (f"workers {counters['workers']:,}   done {counters['loads_finished']:,}   ", ""),
    ]
    troubles = {"loads_failed": "failed", "loads_timed_out": "timed out", "worker_crashes": "crashed"}
    for name, title in troubles.items():
        if counters[name]:
            pieces.append((f"{title} {counters[name]:,}   ", "red"))
    return pieces


def _pressure(counters: dict[str, int]) -> Line:
    return [
        (f"evictions {counters['evictions']:,} ({counters.get('evictions_1min', 0):,} in 1 min)   ", ""),
        (
            f"refused: budget {counters['refused_over_budget']:,}, quota {counters['refused_quota']:,}   ",
            "red" if counters.get("refused_over_budget_1min") else "",
        ),
        (f"retired {counters['zombies']:,}   stale {counters['stale_cells']:,}", ""),
    ]


def _clients(
    clients: Sequence[ClientRow], sessions: int, now_ns: int, width: int, max_clients: int
) -> list[Line]:
    head = f"{'CLIENT':20} {'PID':>8} {'UID':>6} {'CELLS':>6} {'HOLDS':>9} {'REQUESTS':>9} {'IDLE':>8}  AT"
    lines: list[Line] = [[(head[:width], "bold")]]
    ranked = sorted(clients, key=lambda client: -client.bytes)
    for client in ranked[:max_clients]:
        idle_s = max(now_ns - client.last_request_monotonic_ns, 0) * 1e-9
        at = f"{client.pose[0]:.1f},{client.pose[1]:.1f}" if client.pose is not None else "–"
        name = client.client or client.command or "–"
        row = (
            f"{name[:20]:20} {client.pid or '?':>8} {client.uid:>6} {client.cells:>6,}"
            f" {format_bytes(client.bytes):>9} {client.requests:>9,} {format_duration(idle_s):>8}  {at}"
        )
        lines.append([(row[:width], "")])
    more = sessions - min(len(ranked), max_clients)
    if more > 0:
        lines.append([(f"and {more:,} more", "bright_black")])
    if not sessions:
        lines.append([("nobody is connected", "bright_black")])
    return lines

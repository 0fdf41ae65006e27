# SPDX-License-Identifier: Apache-2.0
"""Lines of ``shmmap top`` as styled text: the same on a terminal and in a pipe."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final, TypeAlias

from shmmap.cli.screens.output import counted, format_bytes, format_duration, printable
from shmmap.cli.screens.status_parts import (
    STATE_STYLES,
    live_problems,
    prefetch_words,
    published_words,
    uptime_s,
)
from shmmap.doctor.verdicts import cache_verdict, outage_so_far
from shmmap.statistics.counters import TURN_KINDS

if TYPE_CHECKING:
    from shmmap.protocol.rows import ClientRow, LiveMapRow
    from shmmap.statistics.counters import Histogram
    from shmmap.statistics.identity import DaemonIdentity
    from shmmap.statistics.reader import Snapshot

__all__ = ["Line", "budget_parts", "screen"]

Line: TypeAlias = list[tuple[str, str]]  # (text, style) pieces

LABEL: Final = 12
WORTH_SHOWING_NS: Final = 1_000_000
_WIDE: Final = 100  # from this width on, everything about a client fits
_SHORTEST_NAME: Final = 14
SPAN_TITLES: Final = (("10s", "10 s"), ("1min", "1 min"), ("10min", "10 min"))
_STATE_NAMES: Final = {"healthy": "healthy", "starting": "starting", "stopped": "PAUSED"}
_STATE_STYLES: Final = {
    "healthy": "bold green",
    "starting": "bold yellow",
    "stopped": "bold yellow",
    "hung": "bold red",
    "dead": "bold red",
}
_LATENCIES: Final = {
    "request": "requests",
    "wait": "load waits",
    "load": "load time",
    "load_points": "  of points",
    "load_computed": "  computed",
    "load_cached": "  disk cache",
}
_SOURCES: Final = ("load_points", "load_computed", "load_cached")
"""Statistics of loaders' own time, by kind of work; shown if any."""
_PARTS: Final = (
    # part, name, glyph, style
    ("in_use", "in use", "█", "cyan"),
    ("idle", "idle", "▓", "green"),
    ("retired", "retired", "▒", "yellow"),
    ("loading", "loading", "░", "magenta"),
    ("statistics", "statistics", "░", "blue"),
    ("free", "free", "·", "bright_black"),
)


def budget_parts(counters: dict[str, int]) -> dict[str, int]:
    """Split the budget into bytes: in use, idle (both can be handed out), retired, loading, statistics, free.

    ``loading`` is reserved for loads in progress; ``statistics`` is the size of the statistics segment
    itself.
    """
    resident, zombie = counters["bytes_resident"], counters["bytes_zombie"]
    # retired segments exist only because clients map them
    pinned = min(max(counters["bytes_pinned"] - zombie, 0), resident)
    parts = {
        "in_use": pinned,
        "idle": resident - pinned,
        "retired": zombie,
        "loading": counters["bytes_reserved"],
        "statistics": counters["bytes_statistics"],
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
    """Return the lines of one screen.

    Parameters
    ----------
    width
        Columns of the terminal.
    max_clients
        Maximum rows for clients.
    earlier
        A snapshot of some seconds ago: latencies cover the time since then.  Without it they cover the whole
        run.
    """
    counters = found.counters
    lines = [_title(found, identity), *_flowing("map", _map(identity, counters), width, gap=1), []]
    lines += _budget(counters, width)
    lines.append([])
    lines += _flowing("hits", _hits(counters), width)
    verdict = cache_verdict(counters)
    cache = ("TOO SMALL:", "bold red") if verdict.too_small else ("large enough:", "green")
    words: list[Line] = [[cache], *([(word, "")] for word in verdict.why.split())]
    lines += _flowing("cache", words, width, gap=1)
    if verdict.hint:
        lines += _flowing("", [[(word, "")] for word in verdict.hint.split()], width, gap=1)
    if counters.get("origin_out", 0):
        lines += _flowing("origin", [[(f"out of reach for {outage_so_far(counters)}", "bold red")]], width)
    for label, pieces in (("prefetch", prefetch_words(counters)), ("published", published_words(counters))):
        if pieces:
            units: list[Line] = [[(text, "red" if trouble else "")] for text, trouble in pieces]
            lines += _flowing(label, units, width)
    lines += _latencies(found, earlier)
    lines += _flowing("loop", _longest_turns(counters), width)
    lines += _flowing("queue", _loads(counters), width)
    lines += _flowing("segments", _segments(counters), width)
    for row in found.live:
        lines += _live(row, width)
    lines.append([])
    lines += _clients(found.clients, counters["sessions"], found.beat_monotonic_ns, width, max_clients)
    return lines


def _labelled(label: str, pieces: Line) -> Line:
    return [(label.ljust(LABEL), "bold"), *pieces]


def _flowing(label: str, units: Sequence[Line], width: int, *, gap: int = 3) -> list[Line]:
    """Put units side by side after a label, continued on further lines where one is full."""
    lines: list[Line] = [_labelled(label, [])]
    used = LABEL
    for unit in units:
        length = sum(len(text) for text, _ in unit)
        if used > LABEL and used + gap + length > width:
            lines.append(_labelled("", []))
            used = LABEL
        if used > LABEL:
            lines[-1].append((" " * gap, ""))
            used += gap
        lines[-1] += unit
        used += length
    return lines


def _title(found: Snapshot, identity: DaemonIdentity) -> Line:
    words = {
        "healthy": f"  up {format_duration(uptime_s(identity))}",
        "stopped": f"  no heartbeat for {format_duration(found.beat_age_s)}: `kill -CONT {identity.pid}`",
        "hung": f"  no heartbeat for {format_duration(found.beat_age_s)}",
        "dead": "  crashed or was killed; these are its last figures",
    }.get(found.state, "")
    return [
        ("shmmap ", "bold"),
        (identity.instance, "bold"),
        (f"  pid {identity.pid}  ", ""),
        (
            _STATE_NAMES.get(found.state, found.state.upper()),
            _STATE_STYLES.get(found.state, "bold red"),
        ),
        (words, ""),
    ]


def _map(identity: DaemonIdentity, counters: dict[str, int]) -> list[Line]:
    read_s = max(time.time() - counters.get("last_reload_unix_ns", 0) * 1e-9, 0.0)
    failed = ", LAST RELOAD FAILED" if counters.get("last_reload_failed") else ""
    cells = counted(counters["map_cells"], "cell")
    read = f"read {format_duration(read_s)} ago{failed}"
    return [[(f"{identity.map_path},", "")], [(f"{cells},", "")], [(read, "")]]


def _budget(counters: dict[str, int], width: int) -> list[Line]:
    parts = budget_parts(counters)
    total = max(sum(parts.values()), 1)
    room = max(width - LABEL - 2, 20)
    bar: Line = []
    used = 0
    for index, (name, _, glyph, style) in enumerate(_PARTS):
        cells = room - used if index == len(_PARTS) - 1 else round(room * parts[name] / total)
        if parts[name] and not cells:
            cells = 1  # even a small part is visible
        cells = min(cells, room - used)
        used += cells
        bar.append((glyph * cells, style))
    legend: list[Line] = [
        [(glyph, style), (f" {title} {format_bytes(parts[name])}", "")]
        for name, title, glyph, style in _PARTS
    ]
    budget = format_bytes(counters["budget_bytes"])
    return [_labelled("budget", [(budget, "")]), [(" " * LABEL, ""), *bar], *_flowing("", legend, width)]


def _hits(counters: dict[str, int]) -> list[Line]:
    pieces: list[Line] = []
    for suffix, title in SPAN_TITLES:
        hits, misses = counters.get(f"hits_{suffix}", 0), counters.get(f"misses_{suffix}", 0)
        ratio = f"{100 * hits / (hits + misses):.1f} %" if hits + misses else "–"
        pieces.append([(f"{title}: {ratio}", "")])
    total = counters["hits"] + counters["misses"]
    pieces.append([(f"({counted(total, 'cell')} asked for since the start)", "bright_black")])
    return pieces


def _latencies(found: Snapshot, earlier: Snapshot | None) -> list[Line]:
    lines = []
    for name, title in _LATENCIES.items():
        histogram: Histogram | None = found.histograms.get(name)
        if histogram is None or (name in _SOURCES and not histogram.total):
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


def _longest_turns(counters: dict[str, int]) -> list[Line]:
    """Return the longest turns of the daemon's loop: some above a millisecond, else the longest."""
    longest = {kind: counters.get(f"longest_turn_{kind}_ns", 0) for kind in TURN_KINDS}
    shown = sorted(longest, key=lambda kind: -longest[kind])
    named = [kind for kind in shown if longest[kind] >= WORTH_SHOWING_NS][:3] or shown[:1]
    return [[(f"longest turn {format_duration(longest[kind] * 1e-9)} ({kind})", "")] for kind in named]


def _loads(counters: dict[str, int]) -> list[Line]:
    pieces: list[Line] = [
        [(f"loads {counters['load_queue']:,}", "")],
        [(f"waiting requests {counters['waiting_requests']:,}", "")],
        [(f"loaders {counters['workers']:,}", "")],
        [(f"loads done {counters['loads_finished']:,}", "")],
    ]
    troubles = {"loads_failed": "failed", "loads_timed_out": "timed out", "worker_crashes": "crashed"}
    return pieces + [
        [(f"{title} {counters[name]:,}", "red")] for name, title in troubles.items() if counters[name]
    ]


def _segments(counters: dict[str, int]) -> list[Line]:
    refused = f"refused: budget {counters['refused_over_budget']:,}, quota {counters['refused_quota']:,}"
    evicted = counters.get("evictions_1min", 0)
    return [
        [(f"evicted for room {counters['evictions']:,} ({evicted:,} in 1 min)", "")],
        [(refused, "red" if counters.get("refused_over_budget_1min") else "")],
        [(f"retired {counters['zombies']:,}", "")],
        [(f"stale {counters['stale_cells']:,}", "")],
    ]


def _live(row: LiveMapRow, width: int) -> list[Line]:
    states = [[(f"{count:,} {state}", STATE_STYLES[state])] for state, count in row.states.items() if count]
    memory = f"{format_bytes(row.bytes)} of {format_bytes(row.budget_bytes)}"
    pieces: list[Line] = [
        [(f"{row.name}:", "bold"), (f" {counted(row.chunks, 'chunk')}", "")],
        *states,
        [(memory, "")],
        [(counted(row.active, "known voxel"), "")],
        [(f"scans {row.scans:,}, on disk {row.durable:,}", "")],
    ]
    if row.waiting_bytes:
        pieces.append([(f"waiting {format_bytes(row.waiting_bytes)}", "yellow")])
    lines = _flowing("live", pieces, width)
    for problem in live_problems(row):
        lines += _flowing("", [[(word, "red")] for word in problem.split()], width, gap=1)
    return lines


def _clients(
    clients: Sequence[ClientRow], sessions: int, now_ns: int, width: int, max_clients: int
) -> list[Line]:
    ranked = sorted(clients, key=lambda client: -client.bytes)
    shown = ranked[:max_clients]
    names = [printable(client.client or client.command or "–") for client in shown]
    with_uid = width >= _WIDE
    rest = f" {'PID':>8}{' UID':>7} {'CELLS':>6}" if with_uid else f" {'PID':>8} {'CELLS':>6}"
    rest += f" {'GIVEN':>9} {'REQUESTS':>9} {'IDLE':>8}  AT"
    places = [f"{one.pose[0]:.1f},{one.pose[1]:.1f}" if one.pose is not None else "–" for one in shown]
    # the name gets the columns that the numbers leave
    room = width - len(rest) - max(map(len, places), default=0) + len("AT")
    column = max(_SHORTEST_NAME, min(max(map(len, names), default=0), room))
    lines: list[Line] = [[(f"{'CLIENT':{column}}{rest}"[:width], "bold")]]
    for client, name, at in zip(shown, names, places, strict=True):
        called = name if len(name) <= column else f"{name[: column - 1]}…"
        uid = f" {client.uid:>6}" if with_uid else ""
        row = (
            f"{called:{column}} {client.pid or '?':>8}{uid} {client.cells:>6,}"
            f" {format_bytes(client.bytes):>9} {client.requests:>9,}"
            f" {format_duration(client.idle_s(now_ns)):>8}  {at}"
        )
        lines.append([(row[:width], "")])
    more = sessions - len(shown)
    if more > 0:
        lines.append([(f"and {more:,} more", "bright_black")])
    if not sessions:
        lines.append([("no client is connected", "bright_black")])
    return lines

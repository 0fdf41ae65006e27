# SPDX-License-Identifier: Apache-2.0
"""Lines of ``shmmap top`` as styled text: what matters first, as much as a terminal has room for; or all."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from shmmap.cli.screens.history import History, Sample, spark
from shmmap.cli.screens.letters import columns_of, cut, padded
from shmmap.cli.screens.output import (
    Line,
    counted,
    flowing,
    format_bytes,
    format_duration,
    printable,
    state_style,
)
from shmmap.cli.screens.status_parts import (
    STATE_STYLES,
    live_problems,
    prefetch_words,
    published_words,
    taken_bytes,
    uptime_s,
)
from shmmap.doctor.verdicts import cache_verdict, outage_so_far, problems
from shmmap.statistics.counters import TURN_KINDS, Histogram

if TYPE_CHECKING:
    from shmmap.protocol.rows import ClientRow, LiveMapRow
    from shmmap.statistics.identity import DaemonIdentity
    from shmmap.statistics.reader import Snapshot

LABEL: Final = 12
WORTH_SHOWING_NS: Final = 1_000_000
_WIDE: Final = 100  # from this width on, everything about a client fits
_SHORTEST_NAME: Final = 14
SPAN_TITLES: Final = (("10s", "10 s"), ("1min", "1 min"), ("10min", "10 min"))
_TEXT: Final = 34  # columns of a figure before its history
_SHORTEST_HISTORY: Final = 10
_LOW: Final = 20  # a terminal with fewer lines has no room for histories
_FAR: Final = 1 << 30
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


_RARE: Final = frozenset({"retired", "loading"})
"""Parts that the legend leaves out while they are empty."""
ORDERS: Final[dict[str, Callable[[ClientRow], Any]]] = {
    "memory": lambda client: -client.bytes,
    "requests": lambda client: -client.requests,
    "last request": lambda client: -client.last_request_monotonic_ns,
    "name": lambda client: client.client or client.command,
}
"""Orders of the clients, as the key `s` takes them one after the other."""


def budget_parts(counters: dict[str, int]) -> dict[str, int]:
    """Split the budget into bytes: in use, idle (both can be handed out), retired, loading, statistics, free.

    ``loading`` is reserved for loads in progress; ``statistics`` is the size of the statistics segment
    itself.
    """
    resident, retired = counters["bytes_resident"], counters["bytes_zombie"]
    # retired segments exist only because clients map them
    pinned = min(max(counters["bytes_pinned"] - retired, 0), resident)
    parts = {
        "in_use": pinned,
        "idle": resident - pinned,
        "retired": retired,
        "loading": counters["bytes_reserved"],
        "statistics": counters["bytes_statistics"],
    }
    parts["free"] = max(counters["budget_bytes"] - sum(parts.values()), 0)
    return parts


@dataclass
class View:
    """What the screen shows beside the present figures, and what keys have chosen.

    Attributes
    ----------
    earlier
        A snapshot of some seconds ago: latencies cover the time since then.  Without it they cover the whole
        run.
    history
        What was seen so far; None: no line of it is drawn.
    order
        Order of the clients, a name in `ORDERS`.
    scroll
        Clients above the first that is shown.
    keys
        Whether the last line names keys.
    """

    earlier: Snapshot | None = None
    history: History | None = None
    order: str = "memory"
    scroll: int = 0
    keys: bool = False
    _page: int = 1

    def press(self, key: str) -> None:
        """Scroll, or sort otherwise."""
        if key == "s":
            names = list(ORDERS)
            self.order = names[(names.index(self.order) + 1) % len(names)]
            self.scroll = 0
        steps = {
            "j": 1,
            "down": 1,
            "k": -1,
            "up": -1,
            "page down": self._page,
            " ": self._page,
            "page up": -self._page,
            "g": -self.scroll,
            "home": -self.scroll,
        }
        self.scroll = max(self.scroll + steps.get(key, 0), 0)
        if key in ("G", "end"):
            self.scroll = _FAR

    def page(self, rows: int, clients: int) -> int:
        """Return the first of ``clients`` to show where there is room for this many rows."""
        self._page = max(rows, 1)
        self.scroll = min(self.scroll, max(clients - rows, 0))
        return self.scroll


def screen(
    found: Snapshot,
    identity: DaemonIdentity,
    *,
    width: int,
    height: int | None = None,
    view: View | None = None,
) -> list[Line]:
    """Return the lines of one screen.

    Parameters
    ----------
    width, height
        Columns and lines of the terminal; without lines, everything there is.
    view
        Earlier figures, and what keys have chosen.
    """
    view = view or View()
    counters = found.counters
    head = [
        _title(found, identity),
        *_map(identity, counters, width, short=height is not None),
        *_verdict(found, width),
    ]
    head += _memory(counters, view, width, legend=height is None or height >= _LOW)
    details = _details(found, view, width, whole=height is None)
    if height is None or height >= _LOW:
        head += [*_hits(counters, view, width), *_waits(found, view, width)]
    clients = sorted(found.clients or (), key=ORDERS[view.order])
    sessions = counters["sessions"] if found.clients is None else len(clients)
    if height is None:
        lines = head + [line for block in details for line in block] + [[]]
        return lines + _clients(clients, sessions, found.beat_monotonic_ns, width)
    room = max(height - len(head) - 2, 0)  # without the blank line and the last one
    kept = min(len(clients) + 1, max(room // 2, 2))  # rows of the table, at least
    below: list[Line] = []
    for block in details:
        if len(below) + len(block) + bool(not below) <= room - kept:
            below += block if below else [[], *block]
    count = max(room - len(below) - 1, 0)
    first = view.page(count, len(clients))
    table = _clients(clients[first : first + count], sessions, found.beat_monotonic_ns, width)[
        : room - len(below)
    ]
    hidden = max(sessions, len(clients)) - min(count, len(clients) - first)
    lines = [*head, [], *table, *below]
    lines += [[] for _ in range(height - 1 - len(lines))]
    return [_cut(line, width) for line in [*lines[: height - 1], _last_line(hidden, view)][:height]]


def _cut(line: Line, width: int) -> Line:
    """Return a line of at most ``width`` columns; an ellipsis marks what is cut."""
    if sum(columns_of(printable(text)) for text, _ in line) <= width:
        return line
    shown: Line = []
    room = width - 1
    for text, style in line:
        shown.append((cut(printable(text), room), style))
        room -= columns_of(shown[-1][0])
        if len(shown[-1][0]) < len(printable(text)):
            break
    return [*shown, ("…"[:width], "")]


def _last_line(hidden: int, view: View) -> Line:
    words = [f"{hidden:,} more"] if hidden > 0 else []
    if view.keys:
        words += ["j/k scroll", f"s sort (by {view.order})", "q quit"]
    if view.history is not None and view.history.span_s:
        words.append(f"seen for {format_duration(view.history.span_s)}")
    return [("  ·  ".join(words), "bright_black")]


def _verdict(found: Snapshot, width: int) -> list[Line]:
    """Return the worst that is wrong and what to do, or that nothing is."""
    known = problems(found)
    if not known:
        why = f"the cache is large enough: {cache_verdict(found.counters).why}"
        words = [[("ok:", state_style("ok"))], *_words(why)]
        return _flowing("verdict", words, width, gap=1)
    worst = known[0]
    more = f"; and {len(known) - 1:,} more: `shmmap status`" if known[1:] else ""
    style = state_style(worst.state)
    lines = _flowing("verdict", _words(worst.fact + more, style), width, gap=1)
    return lines + _flowing("", [[("->", style)], *_words(worst.advice)], width, gap=1)


def _words(text: str, style: str = "") -> list[list[tuple[str, str]]]:
    return [[(word, style)] for word in text.split()]


def _details(found: Snapshot, view: View, width: int, *, whole: bool) -> list[list[Line]]:
    """Return further lines in blocks, the most important first; ``whole``: also what stands above them."""
    counters = found.counters
    blocks = [_live(row, width) for row in found.live]
    if counters.get("origin_out", 0):
        out = f"out of reach for {outage_so_far(counters)}"
        blocks.append(_flowing("origin", [[(out, "bold red")]], width))
    cache = cache_verdict(counters)
    if cache.too_small and whole:
        words = [[("TOO SMALL:", "bold red")], *_words(cache.why), *_words(f"-> {cache.hint}")]
        blocks.append(_flowing("cache", words, width, gap=1))
    blocks.append(_latencies(found, view.earlier, whole=whole))
    for label, pieces in (("prefetch", prefetch_words(counters)), ("published", published_words(counters))):
        if pieces:
            units = [[(text, "red" if trouble else "")] for text, trouble in pieces]
            blocks.append(_flowing(label, units, width))
    blocks += [
        _flowing("queue", _loads(counters), width),
        _flowing("segments", _segments(counters), width),
        _flowing("loop", _longest_turns(counters), width),
    ]
    return blocks


def _labelled(label: str, pieces: Line) -> Line:
    return [(label.ljust(LABEL), "bold"), *pieces]


def _flowing(label: str, units: Sequence[Line], width: int, *, gap: int = 3) -> list[Line]:
    """Put units side by side after a label, continued on further lines where one is full."""
    return flowing(units, width, gap=gap, first=_labelled(label, []), later=_labelled("", []))


def _title(found: Snapshot, identity: DaemonIdentity) -> Line:
    state = "paused" if found.state == "stopped" else str(found.state)
    state = state if state in ("healthy", "starting") else state.upper()
    words = {"healthy": f"  up {format_duration(uptime_s(identity))}", "dead": "  these are its last figures"}
    return [
        ("shmmap ", "bold"),
        (identity.instance, "bold"),
        (f"  pid {identity.pid}  ", ""),
        (state, state_style(found.state)),
        (words.get(found.state, ""), ""),
    ]


def _map(identity: DaemonIdentity, counters: dict[str, int], width: int, *, short: bool) -> list[Line]:
    if not identity.map_path:
        return _flowing("map", [[("none: this daemon serves live maps alone", "")]], width)
    read_s = max(time.time() - counters.get("last_reload_unix_ns", 0) * 1e-9, 0.0)
    failed = ", LAST RELOAD FAILED" if counters.get("last_reload_failed") else ""
    path = printable(identity.map_path)
    if short and columns_of(path) > (room := max(width - LABEL - 1, 2)):
        path = f"…{cut(path[::-1], room - 1)[::-1]}"  # its end says more than its start
    units = [f"{path},", f"{counted(counters['map_cells'], 'cell')},"]
    units.append(f"read {format_duration(read_s)} ago{failed}")
    return _flowing("map", [[(text, "")] for text in units], width, gap=1)


def _memory(counters: dict[str, int], view: View, width: int, *, legend: bool) -> list[Line]:
    parts = budget_parts(counters)
    taken, budget = taken_bytes(counters), counters["budget_bytes"]
    text = f"{format_bytes(taken)} of {format_bytes(budget)} ({100 * taken / max(budget, 1):.0f} %)"
    total = max(sum(parts.values()), 1)
    room = max(width - LABEL - 2, 20)
    bar = _labelled("memory", [])
    used = 0
    for index, (name, _, glyph, style) in enumerate(_PARTS):
        cells = room - used if index == len(_PARTS) - 1 else round(room * parts[name] / total)
        if parts[name] and not cells:
            cells = 1  # even a small part is visible
        cells = min(cells, room - used)
        used += cells
        bar.append((glyph * cells, style))
    units = [
        [(glyph, style), (f" {title} {format_bytes(parts[name])}", "")]
        for name, title, glyph, style in _PARTS
        if parts[name] or name not in _RARE
    ]
    below = _flowing("", units, width, gap=1) if legend else []
    return [bar, *below, _with_history("  taken", text, view, width, lambda sample: sample.taken, 1.0)]


def _hits(counters: dict[str, int], view: View, width: int) -> list[Line]:
    ratios = {}
    for suffix, title in SPAN_TITLES:
        hits, misses = counters.get(f"hits_{suffix}", 0), counters.get(f"misses_{suffix}", 0)
        ratios[title] = f"{title}: {100 * hits / (hits + misses):.1f} %" if hits + misses else f"{title}: –"
    if view.history is not None:
        text = f"{ratios['10 s']}  {ratios['10 min']}"
        return [_with_history("hits", text, view, width, lambda sample: sample.hit_ratio, 1.0)]
    total = f"({counted(counters['hits'] + counters['misses'], 'cell')} asked for since the start)"
    units: list[Line] = [[(text, "")] for text in ratios.values()]
    return _flowing("hits", [*units, [(total, "bright_black")]], width)


def _waits(found: Snapshot, view: View, width: int) -> list[Line]:
    """Return a line on requests that waited for loads; everything about them is a latency."""
    if view.history is None:
        return []
    histogram, since = _recent(found, view.earlier, "wait")
    median, slow = histogram.quantile_s(0.5), histogram.quantile_s(0.99)
    text = "none"
    if median is not None and slow is not None:
        text = f"{histogram.total:,}: p50 {format_duration(median)}, p99 {format_duration(slow)}"
    if len(since) + len(text) < _TEXT:
        text = f"{text} {since}"
    return [_with_history("waits", text, view, width, lambda sample: sample.wait_s)]


def _with_history(
    label: str,
    text: str,
    view: View,
    width: int,
    value: Callable[[Sample], float | None],
    highest: float | None = None,
) -> Line:
    """Return a line with what was seen of a value so far, if there is room."""
    room = width - LABEL - _TEXT
    if view.history is None or room < _SHORTEST_HISTORY:
        return _labelled(label, [(text[: max(width - LABEL, 0)], "")])
    drawn = spark(view.history.samples(room), value, highest)
    return _labelled(label, [(f"{text:{_TEXT}}", ""), (drawn, "cyan")])


def _latencies(found: Snapshot, earlier: Snapshot | None, *, whole: bool) -> list[Line]:
    lines = []
    for name, title in _LATENCIES.items():
        if name not in found.histograms or (name in _SOURCES and not found.histograms[name].total):
            continue
        if name == "wait" and not whole:
            continue
        histogram, since = _recent(found, earlier, name)
        lines.append(_labelled(title, [(_quantiles(histogram), ""), (since, "bright_black")]))
    return lines


def _recent(found: Snapshot, earlier: Snapshot | None, name: str) -> tuple[Histogram, str]:
    """Return a histogram of the last seconds, if anything happened in them, else of all; and its span."""
    histogram = found.histograms.get(name, Histogram())
    if earlier is not None and earlier.identity == found.identity and name in earlier.histograms:
        recent = histogram.since(earlier.histograms[name])
        if recent.total:
            span_s = (found.beat_monotonic_ns - earlier.beat_monotonic_ns) * 1e-9
            return recent, f"in the last {format_duration(span_s)}"
    return histogram, "since the start"


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
        [(f"{counted(row.active, 'voxel')} known", "")],
        [(f"scans {row.scans:,}, on disk {row.durable:,}", "")],
    ]
    if row.waiting_bytes:
        pieces.append([(f"waiting {format_bytes(row.waiting_bytes)}", "yellow")])
    lines = _flowing("live", pieces, width)
    for problem in live_problems(row):
        lines += _flowing("", [[(word, "red")] for word in problem.split()], width, gap=1)
    return lines


def _clients(shown: Sequence[ClientRow], sessions: int, now_ns: int, width: int) -> list[Line]:
    """Return the table of clients, cut at ``width``; a name gets what the numbers leave."""
    if not sessions and not shown:
        return [[("no client is connected", "bright_black")]]
    names = [printable(client.client or client.command or "–") for client in shown]
    with_uid = width >= _WIDE
    rest = f" {'GIVEN':>9} {'CELLS':>6} {'PID':>8}{' UID'.rjust(7) if with_uid else ''}"
    rest += f" {'REQUESTS':>9} {'IDLE':>8}  AT"
    places = [f"{one.pose[0]:.1f},{one.pose[1]:.1f}" if one.pose is not None else "–" for one in shown]
    room = width - len(rest) - max(map(len, places), default=0) + len("AT")
    column = max(_SHORTEST_NAME, min(max(map(columns_of, names), default=0), room))
    lines: list[Line] = [[(f"{'CLIENT':{column}}{rest}"[:width], "bold")]]
    for client, name, at in zip(shown, names, places, strict=True):
        called = name if columns_of(name) <= column else f"{cut(name, column - 1)}…"
        uid = f" {client.uid:>6}" if with_uid else ""
        row = (
            f"{padded(called, column)} {format_bytes(client.bytes):>9} {client.cells:>6,}"
            f" {client.pid or '?':>8}{uid} {client.requests:>9,}"
            f" {format_duration(client.idle_s(now_ns)):>8}  {at}"
        )
        lines.append([(cut(row, width), "")])
    return lines

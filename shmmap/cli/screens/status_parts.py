# SPDX-License-Identifier: Apache-2.0
"""Lines of ``status`` and ``top`` about prefetching, a published map and live maps."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Final

from shmmap.doctor.verdicts import signature_lines, trust_problems
from shmmap.quantities import counted, format_bytes, format_duration, format_utc
from shmmap.statistics.counters import LINK_CAUSES

if TYPE_CHECKING:
    from shmmap.protocol.rows import LiveMapRow
    from shmmap.statistics.identity import DaemonIdentity

_NOT_PREPARED: Final = (
    "",
    "; no more: --cache-size is too small for them",
    "; waiting: the cache directory is full or cannot be written",
)
"""What keeps layers from being prepared, by the value of ``prepare_short``."""


def uptime_s(identity: DaemonIdentity) -> float:
    """Return for how long the daemon has run, seconds."""
    return max(time.time() - identity.started_unix_ns * 1e-9, 0.0)


def taken_bytes(counters: Mapping[str, int]) -> int:
    """Return how much of the budget is taken: segments, retired ones, loads under way, the statistics."""
    return sum(counters.get(f"bytes_{name}", 0) for name in ("resident", "zombie", "reserved", "statistics"))


def over_fetch(counters: Mapping[str, int]) -> float | None:
    """Return loaded bytes divided by bytes handed out at least once; None if none were.

    Prefetched bytes that were not used yet count as loaded only.  The ratio is below 1 after a warm start,
    when segments that the previous run loaded are handed out.
    """
    used = counters.get("bytes_used", 0)
    return counters.get("bytes_loaded", 0) / used if used else None


def prefetch_words(counters: Mapping[str, int]) -> list[tuple[str, bool]]:
    """Return short texts about prefetching, each with whether it is a problem; none while it is idle."""
    misses, lately = counters.get("prefetch_misses", 0), counters.get("prefetch_misses_1min", 0)
    if not (counters.get("prefetch_started") or misses):
        return []
    words = [
        (f"{counters['prefetch_started']:,} fetched ahead", False),
        (f"{counters['prefetch_used']:,} then asked for", False),
        (f"{counters['prefetch_in_vain']:,} in vain", False),
        (f"prefetch misses {misses:,} ({lately:,} in 1 min)", lately > 0),
    ]
    if (ratio := over_fetch(counters)) is not None:
        words.append((f"loaded {ratio:.2f} times what was used", False))
    return words


def prepare_words(counters: Mapping[str, int], layers: str) -> str:
    """Return how far the layers of the setting ``prepare`` are; empty if it names none."""
    cells, done = counters.get("prepare_cells", 0), counters.get("prepare_done", 0)
    if not layers:
        return ""
    words = f"{layers}: {done:,} of {counted(cells, 'cell')}"
    if failed := counters.get("prepare_failed", 0):
        words += f", {failed:,} cannot be made: the log names them"
    if again := counters.get("prepare_retries", 0):
        words += f" ({again:,} will be tried again: the loader was killed)"
    return words + _NOT_PREPARED[min(counters.get("prepare_short", 0), len(_NOT_PREPARED) - 1)]


def published_lines(counters: Mapping[str, int]) -> list[tuple[str, str]]:
    """Return label and text of each line about a published map; none if the map is files."""
    if not counters.get("published_version"):
        return []
    lines = [("version", _version(counters)), ("known", _known(counters)), ("fetched", _fetched(counters))]
    if link := _link(counters):
        lines.append(("link", link))
    lines[1:1] = [("signature", text) for text in signature_lines(counters, time.time())]
    if troubles := _troubles(counters):
        lines.append(("", troubles))
    return lines


def published_words(counters: Mapping[str, int]) -> list[tuple[str, bool]]:
    """Return short texts about a published map, each with whether it is a problem."""
    if not counters.get("published_version"):
        return []
    now_s = time.time()
    problems = trust_problems(counters, now_s)
    pieces = [(f"version {_version(counters)}", False)]
    pieces += [(text, text in problems) for text in signature_lines(counters, now_s)]
    pieces += [(_known(counters), False), (_fetched(counters), False), (_troubles(counters), True)]
    return [(text, trouble) for text, trouble in pieces if text]


def since(counters: Mapping[str, int]) -> str:
    """Return `` (since TIME)`` while the origin is out of reach, else an empty string."""
    began_ns = counters.get("origin_out_since_unix_ns", 0)
    return f" (since {format_utc(began_ns // 10**9, seconds=True)})" if began_ns else ""


def _version(counters: Mapping[str, int]) -> str:
    taken_ns = counters["published_taken_unix_ns"]
    ago = format_duration(max(time.time() - taken_ns * 1e-9, 0.0))
    return f"{counters['published_version']}, taken on {format_utc(taken_ns // 10**9)}, {ago} ago"


def _known(counters: Mapping[str, int]) -> str:
    cells, known = counters["map_cells"], counters["map_cells_known"]
    pages = (
        f"{counters['map_pages_known']:,} of {counted(counters['map_pages'], 'page')} of the list of cells"
    )
    return (
        f"all {counted(cells, 'cell')}"
        if known >= cells
        else f"{known:,} of {counted(cells, 'cell')}, {pages}"
    )


def _fetched(counters: Mapping[str, int]) -> str:
    fetched = f"{counted(counters['objects_fetched'], 'object')}, {format_bytes(counters['bytes_fetched'])}"
    disk = f"{counted(counters['objects_from_disk'], 'object')}, {format_bytes(counters['bytes_from_disk'])}"
    return f"{fetched}; from the disk {disk}"


def _link(counters: Mapping[str, int]) -> str:
    """Return what came over the link and for what, and its rate; empty before anything came."""
    by_cause = {cause: counters.get(f"link_{cause}_bytes", 0) for cause in LINK_CAUSES}
    if not any(by_cause.values()):
        return ""
    words = ", ".join(f"{format_bytes(nbytes)} {cause}" for cause, nbytes in by_cause.items())
    rate = counters.get("link_rate_bytes", 0)
    return words + (f"; {8e-6 * rate:.3g} Mbit/s" if rate else "")


def _troubles(counters: Mapping[str, int]) -> str:
    found = (
        ("fetches_failed", "fetches failed"),
        ("objects_damaged_on_disk", "objects were damaged on the disk"),
        ("objects_damaged_in_store", "came damaged from the store"),
    )
    return ", ".join(f"{counters[name]:,} {text}" for name, text in found if counters[name])


STATE_STYLES: Final = {
    "loading": "bright_black",
    "clean": "green",
    "dirty": "blue",
    "saving": "cyan",
    "saved": "bright_black",
}
"""Colours of chunks by state, the same as in Rolling-Bonxai: clean green, dirty blue, not in memory dark."""


def live_problems(row: LiveMapRow) -> list[str]:
    """Return the problems of a live map, one line each."""
    found = [row.problem] if row.problem else []
    if row.damaged_count:
        found.append(f"lost chunks, damaged databases: {row.damaged_count:,}; `shmmap live ls` names them")
    return found


def status_lines(rows: Sequence[LiveMapRow], restarts: int) -> list[tuple[str, str]]:
    """Return the lines of ``status`` about live maps; none without live maps."""
    lines = []
    for row in rows:
        unsaved = f"{row.unsaved:,} not saved" if row.unsaved else "all saved"
        memory = f"{format_bytes(row.bytes)} of {format_bytes(row.budget_bytes)}"
        known = f"{counted(row.active, 'voxel')} known"
        lines.append((f"live {row.name}", f"{counted(row.chunks, 'chunk')}, {memory}, {known}, {unsaved}"))
    if restarts:
        often = counted(restarts, "time")
        lines.append(("", f"the process that keeps live maps ended {often}: see the daemon's log"))
    return lines

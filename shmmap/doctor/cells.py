# SPDX-License-Identifier: Apache-2.0
"""Check cells: whether they load, fit in memory, and are prefetched before moving clients need them."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

from shmmap.doctor.daemon_lists import ANSWER_S
from shmmap.doctor.diagnosis import Diagnosis
from shmmap.doctor.verdicts import Finding, cache_verdict, fail, ok, outage_so_far, warn
from shmmap.errors import ShmmapError
from shmmap.quantities import counted, format_bytes, format_duration

if TYPE_CHECKING:
    from shmmap.statistics.identity import DaemonIdentity

SHORT: Final = ("out of memory", "of memory that a loader may use")
"""Texts in messages of loads that failed for lack of memory."""
NAMED: Final = 3
"""Causes of failures that are listed, at most."""
MAX_MISS_SHARE: Final = 0.02
"""Tolerated share of cells that moving clients wait for, since the points where they turn are unknown."""


def check_cells(diagnosis: Diagnosis) -> Finding:
    """Check that every requested cell can be loaded."""
    failures = diagnosis.counters.get("loads_failed", 0)
    if not failures:
        return ok("no load has failed")
    since = f"{counted(failures, 'load')} failed since the start"
    if diagnosis.state != "healthy" or diagnosis.identity is None:
        return warn(since, "`shmmap tail` names the cells once the daemon answers; so does its log")
    try:
        failing = failing_cells(diagnosis.socket, diagnosis.identity, "shmmap doctor")
    except ShmmapError as error:
        return warn(f"{since}; the daemon was not asked which: {error.message}", "its log says which")
    if not failing and (count := diagnosis.counters.get("unloadable", 0)):
        return fail(
            f"{since}; {counted(count, 'layer')} of cells still cannot be loaded", "its log says which"
        )
    if not failing:
        return ok(f"{since}; no cell is known to fail now")
    fact = f"{counted(len({cell for cell, _ in failing}), 'cell')} cannot be loaded: {causes(failing)}"
    if all(any(map(text.__contains__, SHORT)) for text in failing.values()):
        return warn(
            fact,
            "the files are not to blame: give the daemon more memory (MemoryMax=, docker --memory), or divide"
            " the map into smaller cells",
        )
    if diagnosis.counters.get("origin_out", 0):
        return warn(fact, "they are loaded once the map's origin answers again: see the row `map`")
    blamed = [cell for (cell, _), text in failing.items() if _cause(cell, text) != text]
    if not blamed:
        return fail(fact, "no file is named, so none may be to blame: the daemon's log says more")
    prefix = diagnosis.identity.id_prefix
    return fail(fact, f"`shmmap inspect {prefix}{blamed[0]}` reads the file and says what is wrong with it")


def causes(failing: Mapping[tuple[str, str], str]) -> str:
    """Describe failures by cell and layer: each cause once, with one cell and the number of others."""
    cells: dict[str, list[str]] = {}
    for (cell, layer), message in failing.items():
        cells.setdefault(_cause(cell, message), []).append(f"{cell} ({layer})")
    parts = [
        f"{named[0]}{f' and {len(named) - 1:,} more' if named[1:] else ''}: {cause}"
        for cause, named in list(cells.items())[:NAMED]
    ]
    if len(cells) > NAMED:
        parts.append(f"and {counted(len(cells) - NAMED, 'more cause')}")
    return "; ".join(parts)


def _cause(cell: str, message: str) -> str:
    """Return a failure without the path of its file, whose end is the cell's id, if it begins with that."""
    before, found, cause = message.partition(f"{cell}: ")
    return cause if found and before.startswith("/") else message


def failing_cells(socket: str, identity: DaemonIdentity, name: str) -> dict[tuple[str, str], str]:
    """Return the messages by cell and layer of failed loads that have not succeeded since, as far as known.

    Raises
    ------
    ShmmapError
        The daemon does not answer, or refuses this user.
    """
    from shmmap.client.event_stream import EventStream
    from shmmap.protocol.events import Changed, Failed, Loaded

    since_s = max(time.time() - identity.started_unix_ns * 1e-9, 0.0) + 1.0
    failing: dict[tuple[str, str], str] = {}
    with EventStream(socket, since=since_s, name=name, timeout=ANSWER_S) as stream:
        while (event := stream.next(0.0)) is not None:
            if isinstance(event, Failed):
                failing[event.id, event.layer] = event.message
            elif isinstance(event, Loaded):
                failing.pop((event.id, event.layer), None)
            elif isinstance(event, Changed):
                failing = {key: text for key, text in failing.items() if key[0] != event.id}
    return failing


def check_cache(diagnosis: Diagnosis) -> Finding:
    """Check that the budget is large enough for the clients, by the same rule as ``status``."""
    verdict = cache_verdict(diagnosis.counters)
    if diagnosis.counters.get("refused_over_budget_1min", 0):
        return fail(verdict.text, verdict.hint)
    return warn(verdict.text, verdict.hint) if verdict.too_small else ok(verdict.text)


def check_prefetching(diagnosis: Diagnosis) -> Finding:
    """Check that moving clients find their cells in memory, by the counters of the last ten minutes."""
    count = diagnosis.counters
    misses = count.get("prefetch_misses_10min", 0)
    waited = (
        f"moving clients waited for {counted(misses, 'cell') if misses else 'no cell'} in the last 10 min"
    )
    if not count.get("prefetch_budget_bytes", 0):
        return ok(f"off; {waited}", "raise --prefetch-share" if misses else "")
    if count.get("origin_out", 0):
        return warn(
            f"the map's storage is out of reach: no load has succeeded for {outage_so_far(count)}; {waited}",
            "see to its disk or network; `shmmap tail` says why loads fail",
        )
    outage_s = count.get("last_outage_ns", 0) * 1e-9
    if misses and outage_s > count.get("outage_tolerance_ns", 0) * 1e-9:
        return warn(
            f"{waited}; the map's storage was out of reach for {format_duration(outage_s)}, longer than"
            " --outage-tolerance",
            f"raise --outage-tolerance ({math.ceil(outage_s)})",
        )
    asked = count.get("hits_10min", 0) + count.get("misses_10min", 0)
    if misses <= MAX_MISS_SHARE * asked:
        return ok(waited)
    smaller = "give the clients a smaller radius or a layer with fewer bytes"
    short = count.get("prefetch_short", 0)
    if short == 1:
        share = format_bytes(count["prefetch_budget_bytes"])
        fact = f"{waited}; cells fetched ahead take all of their share, {share}"
        return warn(fact, f"raise --prefetch-share or --budget, or {smaller}")
    if short == 2:
        budget = format_bytes(count.get("budget_bytes", 0))
        fact = f"{waited}; the budget of {budget} is full of what is in use or needed sooner"
        return warn(fact, f"raise --budget, or {smaller}")
    return warn(
        waited,
        "give the daemon more --workers, and have clients send their route (MapWindow.move_to(route=...)):"
        " without one the daemon cannot know where they turn",
    )

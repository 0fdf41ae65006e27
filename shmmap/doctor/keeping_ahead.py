# SPDX-License-Identifier: Apache-2.0
"""Does fetching ahead keep up with the clients?  ``status``, ``top`` and ``doctor`` all say this sentence."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final, Literal, NamedTuple

from shmmap.quantities import counted, format_bytes, format_duration

__all__ = ["AheadState", "AheadVerdict", "ahead_as_json", "ahead_verdict", "outage_so_far", "over_fetch"]

AheadState = Literal["off", "standing", "enough", "filling", "out", "slow", "full", "late"]

MOST_BUSY: Final = 0.8
"""Loaders that keep up may be busy for this much of their time: loads take unequal times."""
FILLED: Final = 0.9
"""How much is in memory is known to a step of the way, and what is just being loaded comes and goes."""
MOST_LATE: Final = 0.02
"""Of what is asked for so much comes late where nobody knows where clients will turn."""
AHEAD_COUNTS: Final = (
    "cells_late",
    "prefetch_started",
    "prefetch_used",
    "prefetch_in_vain",
    "prefetch_overtaken",
    "bytes_prefetched",
)
"""Counters that tell of fetching ahead, told as they are."""
_WORDS: Final[dict[AheadState, str]] = {
    "off": "off",
    "standing": "no client moves",
    "enough": "enough",
    "filling": "not yet filled",
    "out": "OUT OF REACH",
    "slow": "NOT ENOUGH",
    "full": "NOT ENOUGH",
    "late": "NOT ENOUGH",
}


class AheadVerdict(NamedTuple):
    """How fetching ahead is doing, why, and what to change.

    Attributes
    ----------
    state
        ``off`` (it is switched off), ``standing`` (no client moves), ``enough``, ``filling`` (on its way to
        it); ``out``: the map's files are out of reach; ``slow``: loaders cannot give what the clients' motion
        needs; ``full``: there is no memory for as much as is to be ridden out; ``late``: cells come late all
        the same.
    why, hint
        One sentence each; the hint may be empty.
    """

    state: AheadState
    why: str
    hint: str = ""

    @property
    def text(self) -> str:
        """The verdict and its reason."""
        word = _WORDS[self.state]
        return f"{word}: {self.why}" if self.why else word

    @property
    def is_good(self) -> bool:
        """Whether nothing has to be changed."""
        return self.state in ("off", "standing", "enough", "filling")


def over_fetch(counters: Mapping[str, int]) -> float | None:
    """Return bytes loaded by bytes that were handed out at least once; None before the first.

    What is in memory for somebody who will ask for it counts as loaded only.  Below 1 after a warm start,
    when what the daemon before had loaded is handed out.
    """
    used = counters.get("bytes_used", 0)
    return counters.get("bytes_loaded", 0) / used if used else None


def outage_so_far(counters: Mapping[str, int]) -> str:
    """Return how long the origin is out of reach, for a reader: ``"less than a second"``, ``"5.0 s"``."""
    outage_s = counters.get("last_outage_ns", 0) * 1e-9
    return "less than a second" if outage_s < 1.0 else format_duration(outage_s)


def ahead_verdict(counters: Mapping[str, int]) -> AheadVerdict:
    """Judge whether ride-out, budget and loaders fit the speed that is driven."""
    late = counters.get("cells_late_10min", 0)
    came_late = f"{counted(late, 'cell')} came late in the last 10 min" if late else ""
    if not counters.get("prefetch_budget_bytes", 0):
        return AheadVerdict("off", came_late, "raise --prefetch-share" if late else "")
    if not counters.get("moving_clients", 0):
        return AheadVerdict("standing", came_late)
    ahead_s, ride_out_s = counters["ahead_ns"] * 1e-9, counters["ride_out_ns"] * 1e-9
    needed, given = counters["needed_per_1000s"] * 1e-3, counters["loadable_per_1000s"] * 1e-3
    speed = f"{counters['fastest_mm_per_s'] * 1e-3:.1f} m/s"
    memory = f"what clients need for the next {format_duration(ahead_s)} at {speed} is in memory"
    if counters["origin_out"]:
        since = outage_so_far(counters)
        return AheadVerdict(
            "out", f"no load has succeeded for {since}; {memory}", "`shmmap tail` says why loads fail"
        )
    if ahead_s < FILLED * ride_out_s:
        if counters.get("disk_ahead", 0):
            rest = f"the rest of --ride-out ({format_duration(ride_out_s)}) is on the disk"
            return AheadVerdict("enough", f"{memory}; {rest}" + (f"; {came_late}" if late else ""))
        short = f"{memory}, less than --ride-out ({format_duration(ride_out_s)})"
        if given and needed > MOST_BUSY * given:
            return AheadVerdict(
                "slow", f"clients need {_rate(needed)} at {speed}, loaders can do {_rate(given)}",
                f"give the daemon more --workers ({_workers(counters)}), or the clients a smaller radius or a"
                " layer with fewer bytes",
            )  # fmt: skip
        if counters["prefetch_short"] == 1:
            share = format_bytes(counters["prefetch_budget_bytes"])
            return AheadVerdict(
                "full", f"{short}; what is fetched ahead has its {share}",
                "raise --prefetch-share or --budget, or give the clients a smaller radius or a layer with"
                " fewer bytes",
            )  # fmt: skip
        if counters["prefetch_short"] == 2:
            budget = format_bytes(counters["budget_bytes"])
            return AheadVerdict(
                "full", f"{short}; the budget of {budget} is full of what is in use or needed sooner",
                "raise --budget, or give the clients a smaller radius or a layer with fewer bytes",
            )  # fmt: skip
        return AheadVerdict("filling", short + (f"; {came_late}" if late else ""))
    outage_s = counters["last_outage_ns"] * 1e-9
    if late and outage_s > ride_out_s:
        away = f"the map's files were out of reach for {format_duration(outage_s)}"
        return AheadVerdict("late", f"{came_late}; {away}", f"raise --ride-out ({math.ceil(outage_s)})")
    asked = counters["hits_10min"] + counters["misses_10min"]
    if late > MOST_LATE * asked and counters["routed_clients"] < counters["moving_clients"]:
        return AheadVerdict(
            "late", f"{came_late}; {memory}",
            "clients that tell their route (MapWindow.move_to(route=...)) are not surprised by a turn",
        )  # fmt: skip
    rates = f"; they need {_rate(needed)}, loaders can do {_rate(given)}" if given else ""
    return AheadVerdict("enough", f"{memory}{rates}" + (f"; {came_late}" if late else ""))


def ahead_as_json(counters: Mapping[str, int]) -> dict[str, object]:
    """Return the verdict and what it is made of, for programs: seconds, metres a second, loads a second."""
    verdict, ratio = ahead_verdict(counters), over_fetch(counters)
    moving, given = counters.get("moving_clients", 0), counters.get("loadable_per_1000s", 0)
    return {
        "state": verdict.state,
        "why": verdict.why,
        "hint": verdict.hint,
        "ahead_s": round(counters["ahead_ns"] * 1e-9, 3) if moving else None,
        "ride_out_s": counters.get("ride_out_ns", 0) * 1e-9,
        "speed_mps": counters.get("fastest_mm_per_s", 0) * 1e-3,
        "needed_per_s": counters.get("needed_per_1000s", 0) * 1e-3,
        "loadable_per_s": given * 1e-3 if given else None,
        "origin_out": bool(counters.get("origin_out", 0)),
        "last_outage_s": round(counters.get("last_outage_ns", 0) * 1e-9, 3),
        "moving_clients": moving,
        "routed_clients": counters.get("routed_clients", 0),
        **{name: counters.get(name, 0) for name in AHEAD_COUNTS},
        "over_fetch": None if ratio is None else round(ratio, 4),
    }


def _rate(loads_per_s: float) -> str:
    return f"{loads_per_s:,.0f} loads/s" if loads_per_s >= 9.95 else f"{loads_per_s:.1f} loads/s"


def _workers(counters: Mapping[str, int]) -> int:
    """How many loaders would do, if twice as many load twice as fast; one is kept for demands."""
    for_wishes = max(counters["most_workers"] - 1, 1)
    return (
        math.ceil(for_wishes * counters["needed_per_1000s"] / (MOST_BUSY * counters["loadable_per_1000s"]))
        + 1
    )

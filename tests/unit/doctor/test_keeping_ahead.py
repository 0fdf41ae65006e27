# SPDX-License-Identifier: Apache-2.0
"""Whether ride-out, budget and loaders fit the speed that is driven: one verdict, the same for every verb."""

from __future__ import annotations

import pytest

from shmmap.doctor.keeping_ahead import ahead_as_json, ahead_verdict, over_fetch
from shmmap.statistics.counters import COUNTERS

S = 1_000_000_000
MIB = 1 << 20
DRIVING = {
    "prefetch_budget_bytes": 512 * MIB, "budget_bytes": 1024 * MIB, "moving_clients": 2, "routed_clients": 2,
    "fastest_mm_per_s": 12_000, "ahead_ns": 12 * S, "ride_out_ns": 10 * S, "needed_per_1000s": 14_000,
    "loadable_per_1000s": 17_500, "most_workers": 8, "hits_10min": 5000,
}  # fmt: skip
AHEAD = "what clients need for the next 12.0 s at 12.0 m/s is in memory"
LESS = "give the clients a smaller radius or a layer with fewer bytes"
RATES = "they need 14 loads/s, loaders can do 18 loads/s"
SHORT = "what clients need for the next 4.0 s at 12.0 m/s is in memory, less than --ride-out (10.0 s)"


def counters(**values: int) -> dict[str, int]:
    assert set(values) <= {c.name for c in COUNTERS}
    return {c.name: values.get(c.name, 0) for c in COUNTERS}


def driving(**values: int) -> dict[str, int]:
    return counters(**DRIVING | values)


@pytest.mark.parametrize(
    ("values", "state", "text", "hint"),
    [
        (counters(), "off", "off", ""),
        (
            counters(cells_late_10min=2),
            "off", "off: 2 cells came late in the last 10 min", "raise --prefetch-share",
        ),
        (driving(moving_clients=0), "standing", "no client moves", ""),
        (driving(), "enough", f"enough: {AHEAD}; {RATES}", ""),
        (
            driving(loadable_per_1000s=0, cells_late_10min=1),
            "enough", f"enough: {AHEAD}; 1 cell came late in the last 10 min", "",
        ),
        (driving(needed_per_1000s=17_000), "enough", f"enough: {AHEAD}; {RATES.replace('14', '17')}", ""),
        (
            driving(ahead_ns=9 * S, needed_per_1000s=17_000, prefetch_short=1),
            "enough",
            f"enough: {AHEAD.replace('12.0 s', '9.0 s')}; {RATES.replace('14', '17')}",
            "",
        ),
        (driving(ahead_ns=4 * S, loadable_per_1000s=0), "filling", f"not yet filled: {SHORT}", ""),
        (
            driving(ahead_ns=4 * S, needed_per_1000s=1, cells_late_10min=9),
            "filling", f"not yet filled: {SHORT}; 9 cells came late in the last 10 min", "",
        ),
        (
            driving(ahead_ns=4 * S, needed_per_1000s=14_100),
            "slow", "NOT ENOUGH: clients need 14 loads/s at 12.0 m/s, loaders can do 18 loads/s",
            "give the daemon more --workers (9), or the clients a smaller radius or a layer with fewer bytes",
        ),
        (
            driving(ahead_ns=4 * S, prefetch_short=1),
            "full", f"NOT ENOUGH: {SHORT}; what is fetched ahead has its 512 MiB",
            f"raise --prefetch-share or --budget, or {LESS}",
        ),
        (
            driving(ahead_ns=4 * S, prefetch_short=1, disk_ahead=1),
            "enough",
            f"enough: {SHORT.partition(', less')[0]}; the rest of --ride-out (10.0 s) is on the disk",
            "",
        ),
        (
            driving(ahead_ns=4 * S, prefetch_short=2),
            "full",
            f"NOT ENOUGH: {SHORT}; the budget of 1.0 GiB is full of what is in use or needed sooner",
            f"raise --budget, or {LESS}",
        ),
        (
            driving(origin_out=1, last_outage_ns=3 * S),
            "out", f"OUT OF REACH: no load has succeeded for 3.0 s; {AHEAD}",
            "`shmmap tail` says why loads fail",
        ),
        (
            driving(origin_out=1, last_outage_ns=S - 1),
            "out", f"OUT OF REACH: no load has succeeded for less than a second; {AHEAD}",
            "`shmmap tail` says why loads fail",
        ),
        (
            driving(cells_late_10min=1, last_outage_ns=13 * S + 1),
            "late",
            "NOT ENOUGH: 1 cell came late in the last 10 min; the map's files were out of reach for 13.0 s",
            "raise --ride-out (14)",
        ),
        (
            driving(cells_late_10min=150, misses_10min=1000, routed_clients=1),
            "late", f"NOT ENOUGH: 150 cells came late in the last 10 min; {AHEAD}",
            "clients that tell their route (MapWindow.move_to(route=...)) are not surprised by a turn",
        ),
        (
            driving(cells_late_10min=100, misses_10min=1000, routed_clients=1),  # two in a hundred
            "enough",
            f"enough: {AHEAD}; {RATES}; 100 cells came late in the last 10 min",
            "",
        ),
    ],
)  # fmt: skip
def test_verdicts(values: dict[str, int], state: str, text: str, hint: str) -> None:
    verdict = ahead_verdict(values)
    assert (verdict.state, verdict.text, verdict.hint) == (state, text, hint)
    assert verdict.is_good == (state in ("off", "standing", "enough", "filling"))
    told = ahead_as_json(values)
    assert (told["state"], told["hint"]) == (state, hint)


@pytest.mark.parametrize(
    ("needed", "given", "limit"), [(14_100, 17_500, 8), (40_000, 1000, 4), (900, 1000, 1)]
)
def test_as_many_workers_as_it_names_are_enough(needed: int, given: int, limit: int) -> None:
    """Of so many one is kept for demands, and the others load as fast as those that there are."""
    told = ahead_verdict(
        driving(ahead_ns=0, needed_per_1000s=needed, loadable_per_1000s=given, most_workers=limit)
    )
    assert told.state == "slow"
    workers = int(told.hint.partition("(")[2].partition(")")[0])
    more = given * (workers - 1) // max(limit - 1, 1)
    assert workers > limit
    assert (
        ahead_verdict(driving(ahead_ns=0, needed_per_1000s=needed, loadable_per_1000s=more)).state != "slow"
    )


def test_over_fetch() -> None:
    assert over_fetch(counters()) is None
    assert over_fetch(counters(bytes_loaded=105, bytes_used=100)) == 1.05
    assert ahead_as_json(counters())["over_fetch"] is None


def test_a_daemon_of_an_earlier_version_says_nothing_of_it() -> None:
    assert ahead_verdict({"hits": 3}).text == "off"
    told = ahead_as_json({"hits": 3})
    assert (told["ahead_s"], told["loadable_per_s"], told["cells_late"]) == (None, None, 0)


def test_what_programs_are_told() -> None:
    told = ahead_as_json(driving(last_outage_ns=2 * S, prefetch_used=7, bytes_loaded=11, bytes_used=10))
    assert told == {
        "state": "enough", "why": told["why"], "hint": "", "ahead_s": 12.0, "ride_out_s": 10.0,
        "speed_mps": 12.0, "needed_per_s": 14.0, "loadable_per_s": 17.5, "origin_out": False,
        "last_outage_s": 2.0, "moving_clients": 2, "routed_clients": 2, "cells_late": 0,
        "prefetch_started": 0,
        "prefetch_used": 7, "prefetch_in_vain": 0, "prefetch_overtaken": 0, "bytes_prefetched": 0,
        "over_fetch": 1.1,
    }  # fmt: skip

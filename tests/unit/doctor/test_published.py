# SPDX-License-Identifier: Apache-2.0
"""Doctor's rows of a published map, from answers of its store and statistics of the daemon."""

from __future__ import annotations

import time
from typing import Any

import pytest

from shmmap.doctor.checks import CHECKS
from shmmap.doctor.store_probe import StoreAnswer
from shmmap.statistics.counters import REFUSALS
from tests.unit.doctor.conftest import Ward, snapshot

URL = "s3://maps/town"
ROWS = ("link", "credentials", "clock", "versions")
ANSWERS: dict[str, Any] = {
    "answers": True,
    "first_s": 0.012,
    "next_s": 0.003,
    "version": 7,
    "credentials": "somewhere",
}


def look(ward: Ward, answer: StoreAnswer, **counters: int) -> dict[str, tuple[str, str]]:
    """State and text of each row."""
    counts = {"published_version": 7, "published_refused": 0, "published_expires_unix_ns": 0}
    counts |= {"published_taken_unix_ns": time.time_ns(), **counters}
    diagnosis = ward.diagnosis(snapshot(**counts), map_path=URL)  # type: ignore[arg-type]
    assert diagnosis.seen is not None
    diagnosis.seen.identity = None  # the map is that of the settings
    diagnosis.__dict__["store"] = answer
    found = {name: CHECKS[name](diagnosis) for name in ROWS}
    return {
        name: ("skip" if one.skipped else one.state, f"{one.fact} -> {one.advice}")
        for name, one in found.items()
    }


def test_all_well(ward: Ward) -> None:
    found = look(ward, StoreAnswer(**ANSWERS, clock_s=-3.0))
    assert {state for state, _ in found.values()} == {"ok"}
    assert "12.0 ms for a small object over a new connection, 3.0 ms for the next one" in found["link"][1]
    assert "within 3 s" in found["clock"][1]


@pytest.mark.parametrize(
    ("answer", "row", "state", "says"),
    [
        ({"credentials": "x"}, "link", "warn", "no answer within 12 s"),
        ({"error": f"{URL}/CURRENT: no answer"}, "link", "warn", "no answer; the daemon reached it when"),
        ({"credentials_error": "half a pair"}, "credentials", "warn", "can be seen with sudo"),
        ({"credentials_error": "half a pair"}, "link", "skip", "see credentials"),
        (
            {"answers": True, "is_refused": True, "error": "refused"},
            "link",
            "ok",
            "refuses what this account has",
        ),
        ({"is_refused": True, "error": "no!", "credentials": "x"}, "credentials", "warn", "no!"),
        ({"answers": True, "clock_s": 61.0}, "clock", "warn", "61.0 s behind the store's"),
        ({"answers": True, "clock_s": -3601.0}, "clock", "warn", "60 min ahead of the store's"),
        ({"answers": True}, "clock", "skip", "does not say"),
        ({"version": 6}, "versions", "warn", "version 6 is offered, which is older"),
        ({"version": 8}, "versions", "ok", "version 8 is offered -> it is taken at the next --poll"),
        ({"version": 7, "created_s": 0.0}, "versions", "ok", "it is what is offered"),
        ({}, "versions", "ok", "what is offered is not known"),
    ],
)
def test_what_is_not_as_it_should_be(
    ward: Ward, answer: dict[str, Any], row: str, state: str, says: str
) -> None:
    found = look(ward, StoreAnswer(**answer))
    assert found[row][0] == state
    assert says in found[row][1]


def test_the_daemon_may_be_worse_off(ward: Ward) -> None:
    found = look(ward, StoreAnswer(**ANSWERS), origin_out=1, last_outage_ns=90 * 10**9)
    assert found["link"][0] == "warn"
    assert "the daemon has not reached it for 90.0 s" in found["link"][1]


@pytest.mark.parametrize("refusal", [*range(1, len(REFUSALS)), 77])
def test_a_refused_offer_is_in_the_row_of_versions(ward: Ward, refusal: int) -> None:
    found = look(ward, StoreAnswer(**ANSWERS), published_refused=9, published_refusal=refusal)
    state, text = found["versions"]
    cause = REFUSALS[min(refusal, len(REFUSALS) - 1)].replace("_", " ")
    why = "cannot be taken" if cause == "other" else f"is refused, {cause}"
    assert (state, f"version 9, which is offered, {why}: what was taken is served" in text) == ("warn", True)
    assert not text.endswith("-> "), "there is advice for each cause"

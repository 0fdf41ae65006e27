# SPDX-License-Identifier: Apache-2.0
"""The daemon's prefetch policy on a short drive beside a slow origin, in simulated time."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from shmmap.origin.catalogue import Catalogue
from tests.benchmarks.slow_origin_drives import Drive, dense_catalogue, town_drive
from tests.benchmarks.slow_origin_model import OUTAGES, Counts, Outages, SlowOrigin
from tests.benchmarks.slow_origin_run import Setting, simulate


@cache
def drive() -> tuple[Drive, Catalogue]:
    """Three minutes through the town at 12 m/s."""
    found = town_drive(3, 2400.0)
    return found, dense_catalogue(found)


def driven(row: str, outages: Outages, seed: int = 0) -> Counts:
    return simulate(*drive(), SlowOrigin(0.4, outages, seed), Setting(row))


@pytest.mark.parametrize("seed", range(4))
def test_with_a_route_an_outage_is_ridden_out(seed: int) -> None:
    counts = driven("route", OUTAGES["10 s / 120 s"], seed)
    assert counts.full_s < 120.0
    assert counts.late == 0
    assert counts.warm == 1.0
    assert counts.over_fetch < 1.15, "of a short drive, what lies beyond its end is a larger part"


def test_an_outage_that_is_longer_than_that_is_not() -> None:
    assert driven("route", Outages(40.0, 120.0, 120.0)).late > 50


@pytest.mark.slow
def test_without_a_route_few_wait() -> None:
    """Of a short drive with slow loads at the wrong moment more wait than of many drives."""
    drives = [driven("no route", OUTAGES["none"], seed) for seed in range(8)]
    assert all(counts.warm >= 0.9 for counts in drives)
    assert np.mean([counts.warm for counts in drives]) >= 0.96
    assert max(counts.over_fetch for counts in drives) <= 1.25


def test_with_a_trajectory_none_waits() -> None:
    assert driven("trajectory", OUTAGES["none"]).late == 0


def test_what_is_compared_with() -> None:
    """Nothing fetched ahead is the worst, and fetches nothing in vain; knowing the future is best."""
    none, oracle = driven("none", OUTAGES["none"]), driven("oracle", OUTAGES["none"])
    assert none.warm < 0.3
    assert none.over_fetch < 1.02
    assert oracle.late == 0
    assert oracle.over_fetch < 1.02


def test_loads_that_meet_an_outage_fail() -> None:
    outages = Outages(10.0, 120.0, 120.0)
    for begin_s, end_s, meets in (
        (0.0, 119.9, False), (119.0, 120.0, True), (125.0, 126.0, True), (130.0, 131.0, True),
        (130.1, 239.0, False), (130.1, 240.0, True), (0.0, 0.1, False), (100.0, 1000.0, True),
    ):  # fmt: skip
        assert outages.meets(begin_s, end_s) is meets, (begin_s, end_s)
    assert not OUTAGES["none"].meets(0.0, 1e6)
    assert outages.up == pytest.approx(11 / 12)

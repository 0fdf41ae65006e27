# SPDX-License-Identifier: Apache-2.0
"""What evidence is worth: Rolling-Bonxai's figures, in thousandths."""

from __future__ import annotations

import math

import pytest

from shmmap.chunks.marking import Marker
from shmmap.chunks.occupancy import Occupancy, ScanFilter, log_odds, probability
from shmmap.errors import ConfigError


def test_the_defaults_are_rolling_bonxai_s() -> None:
    assert Occupancy().steps == (847, -405, -1992, 3476)
    assert Occupancy().thresholds == (0, 0)
    assert ScanFilter() == ScanFilter(min_range=0.5, max_range=5.0, min_z=-2.0, max_z=2.0)


def test_log_odds_and_back() -> None:
    assert [log_odds(p) for p in (0.5, 0.9, 0.1)] == [0, 2197, -2197]
    assert probability(0) == 0.5
    assert probability(log_odds(0.7)) == pytest.approx(0.7, abs=1e-3)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("hit", 0.5), ("hit", 0.4), ("hit", 1.0), ("hit", math.nan), ("miss", 0.5), ("miss", 0.6),
        ("miss", 0.0), ("clamp_min", 0.5), ("clamp_max", 0.5), ("clamp_max", 1.5), ("occupied_above", 0.4),
        ("occupied_above", 0.97), ("free_below", 0.6), ("free_below", 0.12), ("hit", 0.5001),
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_refused(key: str, value: float) -> None:
    with pytest.raises(ConfigError, match=key) as caught:
        Occupancy(**{key: value})
    assert caught.value.key == key


@pytest.mark.parametrize(
    ("key", "values"),
    [
        ("max_range", {"max_range": 0.5}), ("max_range", {"max_range": math.inf}),
        ("min_range", {"min_range": math.nan}), ("min_range", {"min_range": -1.0}), ("max_z", {"min_z": 2.0}),
    ],
)  # fmt: skip
def test_a_filter_that_lets_nothing_through_is_refused(key: str, values: dict[str, float]) -> None:
    with pytest.raises(ConfigError) as caught:
        ScanFilter(**values)
    assert caught.value.key == key


def test_rays_have_a_greatest_length() -> None:
    Marker(0.05, ScanFilter(max_range=201.0))
    with pytest.raises(ConfigError, match=r"at most 201\.6 m"):
        Marker(0.05, ScanFilter(max_range=202.0))

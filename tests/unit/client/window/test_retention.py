# SPDX-License-Identifier: Apache-2.0
"""Retention: limits hold, nearest first, nothing kept for the sake of something farther."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmmap.client.window.retention import Retention, RetentionCandidate
from shmmap.errors import BadRequest

departed = st.lists(
    st.builds(
        RetentionCandidate,
        distance=st.floats(0, 500),
        nbytes=st.integers(0, 10_000),
        age=st.floats(0, 1000),
    ),
    max_size=20,
)
policies = st.builds(
    Retention,
    distance=st.floats(0, 600),
    max_bytes=st.one_of(st.just(math.inf), st.integers(0, 40_000)),
    max_age=st.one_of(st.just(math.inf), st.floats(0, 1200)),
)


@given(policies, departed)
def test_limits_hold_and_the_nearest_come_first(policy: Retention, cells: list[RetentionCandidate]) -> None:
    kept = policy.keep(cells)
    assert len(kept) == len(cells)
    held = [cell for cell, keep in zip(cells, kept, strict=True) if keep]
    dropped = [cell for cell, keep in zip(cells, kept, strict=True) if not keep]
    assert sum(cell.nbytes for cell in held) <= policy.max_bytes
    assert all(cell.distance <= policy.distance and cell.age <= policy.max_age for cell in held)
    eligible = [c for c in dropped if c.distance <= policy.distance and c.age <= policy.max_age]
    if policy.distance and eligible:
        nearest = min(eligible, key=lambda cell: (cell.distance, cell.age))
        assert all((c.distance, c.age) <= (nearest.distance, nearest.age) for c in held)
        assert sum(cell.nbytes for cell in held) + nearest.nbytes > policy.max_bytes


def test_the_default_keeps_nothing() -> None:
    assert Retention().keep([RetentionCandidate(0.0, 0, 0.0)]) == [False]


@pytest.mark.parametrize("limit", ["distance", "max_bytes", "max_age"])
@pytest.mark.parametrize("value", [-1.0, math.nan])
def test_impossible_limits_are_refused(limit: str, value: float) -> None:
    with pytest.raises(BadRequest, match=limit):
        Retention(**{limit: value})

# SPDX-License-Identifier: Apache-2.0
"""What the daemon makes of loads that end or fail."""

from __future__ import annotations

import math

from hypothesis import given
from hypothesis import strategies as st

from shmmap.daemon.loading.look_ahead import IN_A_ROW, PROBE_S, OriginHealth


def test_before_the_first_load() -> None:
    health = OriginHealth()
    assert (health.slow_s, health.is_out) == (0.0, False)
    assert health.next_try_s() == -math.inf


def test_a_few_that_fail_say_nothing_of_the_others() -> None:
    health = OriginHealth()
    for _ in range(IN_A_ROW - 1):
        assert not health.ended(0.1, failed=True)
    assert not health.is_out
    assert not health.ended(0.1, failed=False), "it was not away"
    assert health.failed_in_a_row == 0


def test_many_in_a_row_do_and_the_first_that_succeeds_ends_it() -> None:
    health = OriginHealth()
    health.tried(7.0)
    for _ in range(IN_A_ROW):
        health.ended(0.1, failed=True)
    assert health.is_out
    assert health.next_try_s() == 7.0 + PROBE_S
    health.tried(8.0)
    assert health.next_try_s() == 8.0 + PROBE_S
    assert health.ended(0.1, failed=False)
    assert not health.ended(0.1, failed=False), "it is told once"
    assert health.next_try_s() == -math.inf


@given(st.lists(st.floats(0.0, 100.0), min_size=1, max_size=200))
def test_times_are_those_of_the_last_loads(times: list[float]) -> None:
    health = OriginHealth()
    for took_s in times:
        health.ended(took_s, failed=False)
        health.ended(1e9, failed=True)
    last = times[-64:]
    assert sum(took_s > health.slow_s for took_s in last) <= len(last) / 20
    assert health.slow_s in last


def test_loads_that_succeed_although_the_origin_is_away_are_not_held_back() -> None:
    """What they need is on the disk."""
    health = OriginHealth(unreachable=True)
    health.tried(10.0)
    health.ended(0.1, failed=False)
    assert health.is_out
    assert health.next_try_s() == -math.inf
    health.tried(11.0)
    health.ended(0.1, failed=True)
    assert health.next_try_s() == 11.0 + PROBE_S

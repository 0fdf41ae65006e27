# SPDX-License-Identifier: Apache-2.0
"""What the daemon measures at its beats, and what it writes of that."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmmap.daemon.loading.look_ahead import IN_A_ROW
from shmmap.daemon.telemetry.sampler import (
    BEAT_S,
    IDLE_AFTER_S,
    IDLE_BEAT_S,
    RecentCounts,
    Sampler,
)
from shmmap.daemon.turns import WatchedDescriptors
from shmmap.statistics.counters import SPANS, WINDOWED
from tests.support.divided_map import DividedMap
from tests.unit.daemon.inner_daemon import Inner, InnerDaemon

S = 1_000_000_000


def beat(sampler: Sampler, now_s: float) -> int:
    """Have the sampler do what is due; returns in how many turns."""
    count = 0
    while sampler.next_s <= now_s:
        sampler.run_step(now_s)
        count += 1
    return count


def sampler_of(
    one: InnerDaemon, on_beat: Callable[[], None] = lambda: None, watched: WatchedDescriptors | None = None
) -> Sampler:
    return Sampler(
        one.cache, one.cache.survey, one.scheduler, one.statistics, one.event_log, one.sessions,
        watched or WatchedDescriptors(), (), on_beat,
    )  # fmt: skip


def test_an_idle_daemon_sleeps(inner: Inner, small_map: DividedMap) -> None:
    """A beat a second in a few steps; what arrives brings the usual beats back at once."""
    one = inner(small_map.root)
    one.everything()
    watched, now_s, beats = WatchedDescriptors(), 1000.0, list[float]()
    sampler = sampler_of(one, lambda: beats.append(now_s), watched)

    def steps(seconds: float) -> int:
        """The steps of some seconds in which nothing arrives, each at its time."""
        nonlocal now_s
        count, end_s = 0, now_s + seconds
        while sampler.next_s <= end_s:
            now_s = max(now_s, sampler.next_s)
            sampler.run_step(now_s)
            count += 1
        now_s = end_s
        return count

    busy = steps(IDLE_AFTER_S)
    assert len(beats) >= IDLE_AFTER_S / BEAT_S
    beats.clear()
    assert steps(60.0) <= 60 * 6 < busy / IDLE_AFTER_S * 60 / 4
    assert len(beats) == pytest.approx(60 / IDLE_BEAT_S, abs=1)
    beats.clear()
    now_s += 0.3
    watched.wakes += 1
    assert sampler.next_s <= now_s
    steps(1.0)
    assert len(beats) >= 1.0 / BEAT_S
    watched.close()


def test_outages_of_the_storage(inner: Inner, small_map: DividedMap) -> None:
    one = inner(small_map.root)
    health = one.scheduler.prefetcher.prefetch.health
    sampler, values = sampler_of(one), one.statistics.values

    def measured(now_s: float) -> tuple[int, int, int, bool]:
        beat(sampler, now_s)
        is_dated = values["origin_out_since_unix_ns"] > 0
        return values["origin_out"], values["origin_outages"], values["last_outage_ns"], is_dated

    assert measured(100.0) == (0, 0, 0, False)
    health.failed_in_a_row = IN_A_ROW
    assert measured(101.0) == (1, 1, 0, True)
    assert measured(105.0) == (1, 1, 4 * S, True)
    health.ended(0.1, failed=False)
    assert measured(106.0) == (0, 1, 5 * S, False)
    assert measured(200.0) == (0, 1, 5 * S, False)
    for _ in range(IN_A_ROW):
        health.ended(3.0, failed=True)
    assert measured(300.0) == (1, 2, 3 * S, True), "it was away when what has failed was begun"


def test_what_limits_prefetching(inner: Inner, small_map: DividedMap) -> None:
    one = inner(small_map.root, prefetch_share=0.5, outage_tolerance_s=2.4)
    sampler, values = sampler_of(one), one.statistics.values

    def short(now_s: float) -> int:
        beat(sampler, now_s)
        return values["prefetch_short"]

    assert short(1000.0) == 0
    assert (values["prefetch_budget_bytes"], values["outage_tolerance_ns"]) == (32 << 20, 2_400_000_000)
    one.ledger.prefetched_bytes = 32 << 20
    assert short(1001.0) == 1
    one.ledger.prefetched_bytes = 0
    one.scheduler.prefetcher.full(1002.0)
    assert short(1002.0) == 2
    off = inner(small_map.root)
    beat(sampler_of(off), 1000.0)
    assert (off.statistics.values["prefetch_budget_bytes"], off.statistics.values["prefetch_short"]) == (0, 0)


def counted(hits: int) -> dict[str, int]:
    """Counters, two of which are not 0."""
    return {**dict.fromkeys(WINDOWED, 0), "hits": hits, "misses": -hits}


@given(st.lists(st.tuples(st.floats(0.01, 30.0), st.integers(0, 5)), max_size=200))
def test_growth_over_a_span_is_right_to_a_second(steps: list[tuple[float, int]]) -> None:
    recent = RecentCounts()
    now_s, total = 100.0, 3
    history = [(now_s, total)]
    recent.look(counted(total), now_s)
    for wait_s, more in steps:
        now_s, total = now_s + wait_s, total + more
        history.append((now_s, total))
        recent.look(counted(total), now_s)
        found = recent.growth(counted(total), now_s)
        assert all(found[f"misses_{name}"] == -found[f"hits_{name}"] for name in SPANS)
        for name, span in SPANS.items():
            growth = found[f"hits_{name}"]
            inside = total - max((v for t, v in history if t <= now_s - span), default=3)
            early = [t for t, _ in history if t <= now_s - span]
            # a look less than a second after the one before is not remembered
            outer = total - max((v for t, v in history if t <= (early[-1] if early else 0) - 1.0), default=3)
            assert inside <= growth <= outer


def test_the_longest_span_is_remembered() -> None:
    recent = RecentCounts()
    for second in range(2000):
        recent.look(counted(second), float(second))
    assert recent.growth(counted(1999), 1999.0)["hits_10min"] == 600

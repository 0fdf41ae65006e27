# SPDX-License-Identifier: Apache-2.0
"""Growth over spans and the census of pins."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from shmmap.daemon.cache.ledger import Key, Resident
from shmmap.daemon.cache.pin_census import PinCensus
from shmmap.daemon.telemetry.recent_counts import RecentCounts


@given(st.lists(st.tuples(st.floats(0.01, 30.0), st.integers(0, 5)), max_size=200))
def test_growth_over_a_span_is_right_to_a_second(steps: list[tuple[float, int]]) -> None:
    recent = RecentCounts(("hits",), (10.0, 60.0))
    now_s, total = 100.0, 3
    history = [(now_s, total)]
    recent.look({"hits": total}, now_s)
    for wait_s, more in steps:
        now_s, total = now_s + wait_s, total + more
        history.append((now_s, total))
        recent.look({"hits": total}, now_s)
        for span, (growth,) in zip((10.0, 60.0), recent.growth({"hits": total}, now_s), strict=True):
            inside = total - max((v for t, v in history if t <= now_s - span), default=3)
            early = [t for t, _ in history if t <= now_s - span]
            # a look less than a second after the one before is not remembered
            outer = total - max((v for t, v in history if t <= (early[-1] if early else 0) - 1.0), default=3)
            assert inside <= growth <= outer


def test_the_longest_span_is_remembered() -> None:
    recent = RecentCounts(("hits",), (600.0,))
    for second in range(2000):
        recent.look({"hits": second}, float(second))
    assert recent.growth({"hits": 1999}, 1999.0) == [(600,)]


def resident(name: str, nbytes: int = 10) -> Resident:
    return Resident(name, Key(name, "points"), 1, nbytes, 1, (0.0, 0.0, 1.0, 1.0), 0.0, 1.0)


def test_pins_are_counted_a_few_at_a_time() -> None:
    segments = [resident(str(number), nbytes=10 + number) for number in range(10)]
    pinned = {"1", "2", "9"}
    census = PinCensus(lambda: segments, lambda one: one.name in pinned)
    for _ in range(4):
        census.look(3)
    assert (census.pinned_count, census.pinned_bytes) == (3, 11 + 12 + 19)
    pinned = {"2"}
    del segments[9]
    for _ in range(8):
        census.look(3)
    assert (census.pinned_count, census.pinned_bytes) == (1, 12)
    segments.clear()
    for _ in range(5):
        census.look(3)
    assert (census.pinned_count, census.pinned_bytes) == (0, 0)


def test_a_segment_that_vanished_is_not_pinned() -> None:
    census = PinCensus(lambda: [resident("a")], lambda _: None)
    census.look(5)
    assert census.pinned_bytes == 0

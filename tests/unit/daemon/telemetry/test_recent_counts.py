# SPDX-License-Identifier: Apache-2.0
"""How much counters grew over spans."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

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

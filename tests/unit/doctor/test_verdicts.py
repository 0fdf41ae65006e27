# SPDX-License-Identifier: Apache-2.0
"""Whether the cache is too small: one verdict, the same for every verb that shows it."""

from __future__ import annotations

import pytest

from shmmap.doctor.verdicts import cache_verdict
from shmmap.statistics.counters import COUNTERS

MIB = 1 << 20


def counters(**values: int) -> dict[str, int]:
    assert set(values) <= {c.name for c in COUNTERS}
    return {c.name: values.get(c.name, 0) for c in COUNTERS}


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({}, "large enough: nothing evicted for room, nothing refused"),
        (
            {"evictions": 29},
            (
                "large enough: nothing evicted for room or refused in the last 10 min"
                " (29 evicted for room since the start)"
            ),
        ),
        (
            {"evictions": 29, "refused_over_budget": 4},
            (
                "large enough: nothing evicted for room or refused in the last 10 min"
                " (29 evicted for room and 4 refused since the start)"
            ),
        ),
        ({"refused_quota": 9}, "large enough: nothing evicted for room, nothing refused"),
        (
            {"evictions_10min": 50, "misses_10min": 500, "loads_after_eviction_10min": 5, "evictions": 50},
            "large enough: 50 evicted for room in the last 10 min, hardly any asked for again",
        ),
        (
            {"evictions_10min": 50, "misses_10min": 50, "loads_after_eviction_10min": 30},
            "TOO SMALL: 30 loads in the last 10 min (60 % of all) were of cells evicted before",
        ),
        (
            {"refused_over_budget_10min": 2, "bytes_pinned": MIB, "budget_bytes": MIB},
            "TOO SMALL: 2 cells refused in the last 10 min; clients use 1.0 MiB of 1.0 MiB",
        ),
    ],
)
def test_the_verdict(values: dict[str, int], text: str) -> None:
    verdict = cache_verdict(counters(**values))
    assert verdict.text == text
    assert ("--budget" in verdict.hint) == verdict.too_small == text.startswith("TOO SMALL")

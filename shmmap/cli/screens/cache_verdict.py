# SPDX-License-Identifier: Apache-2.0
"""Is the cache too small?  One sentence, from what happened in the last ten minutes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

from shmmap.cli.screens.output import format_bytes

__all__ = ["Verdict", "cache_verdict"]

AGAIN_SHARE: Final = 0.05
AGAIN_COUNT: Final = 10
"""Fewer loads than this tell nothing, whatever their share."""


class Verdict(NamedTuple):
    """Whether the budget is too small, what makes one think so, and what to do."""

    too_small: bool
    why: str
    hint: str = ""


def cache_verdict(counters: Mapping[str, int]) -> Verdict:
    """Judge the budget by what was refused, and by what was loaded again after it had made room."""
    refused = counters.get("refused_over_budget_10min", 0)
    evicted = counters.get("evictions_10min", 0)
    again = counters.get("loads_after_eviction_10min", 0)
    misses = max(counters.get("misses_10min", 0), again)
    budget, pinned = counters.get("budget_bytes", 0), counters.get("bytes_pinned", 0)
    if refused:
        return Verdict(
            True,
            f"{refused:,} cells refused in 10 min; clients map {format_bytes(pinned)} of"
            f" {format_bytes(budget)}",
            "raise --budget; `shmmap clients` says who holds what",
        )
    if again >= AGAIN_COUNT and again > AGAIN_SHARE * misses:
        share = 100 * again / misses
        return Verdict(
            True,
            f"{again:,} loads in 10 min ({share:.0f} % of all) were of cells evicted before",
            "raise --budget",
        )
    if evicted:
        return Verdict(False, f"{evicted:,} evictions in 10 min, and hardly any were asked for again")
    return Verdict(False, "nothing had to be evicted in 10 min")

# SPDX-License-Identifier: Apache-2.0
"""What the counters alone say: whether the cache is too small, how long the storage is out of reach.

``status``, ``top`` and ``doctor`` say it in the same words.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

from shmmap.quantities import format_bytes, format_duration

__all__ = ["Verdict", "cache_verdict", "outage_so_far"]

AGAIN_SHARE: Final = 0.05
AGAIN_COUNT: Final = 10
"""Fewer loads than this tell nothing, whatever their share."""


class Verdict(NamedTuple):
    """Whether the budget is too small, why, and what to do."""

    too_small: bool
    why: str
    hint: str = ""

    @property
    def text(self) -> str:
        """The verdict and its reason."""
        return f"{'TOO SMALL' if self.too_small else 'large enough'}: {self.why}"


def cache_verdict(counters: Mapping[str, int]) -> Verdict:
    """Judge the budget by the last ten minutes: what was refused, and what was loaded again after eviction.

    What was refused for a client's quota says nothing of the budget.
    """
    refused = counters.get("refused_over_budget_10min", 0)
    evicted = counters.get("evictions_10min", 0)
    again = counters.get("loads_after_eviction_10min", 0)
    misses = max(counters.get("misses_10min", 0), again)
    budget, in_use = counters.get("budget_bytes", 0), counters.get("bytes_pinned", 0)
    if refused:
        return Verdict(
            True,
            f"{refused:,} cells refused in the last 10 min; clients use {format_bytes(in_use)} of"
            f" {format_bytes(budget)}",
            "raise --budget; `shmmap clients` says who uses the memory",
        )
    if again >= AGAIN_COUNT and again > AGAIN_SHARE * misses:
        share = 100 * again / misses
        return Verdict(
            True,
            f"{again:,} loads in the last 10 min ({share:.0f} % of all) were of cells evicted before",
            "raise --budget",
        )
    if evicted:
        return Verdict(False, f"{evicted:,} evicted for room in the last 10 min, hardly any asked for again")
    past = [
        f"{count:,} {what}"
        for count, what in (
            (counters.get("evictions", 0), "evicted for room"),
            (counters.get("refused_over_budget", 0), "refused"),
        )
        if count
    ]
    if past:
        before = " and ".join(past)
        return Verdict(
            False, f"nothing evicted for room or refused in the last 10 min ({before} since the start)"
        )
    return Verdict(False, "nothing evicted for room, nothing refused")


def outage_so_far(counters: Mapping[str, int]) -> str:
    """Return how long the map's storage is out of reach: ``"less than a second"``, ``"5.0 s"``."""
    outage_s = counters.get("last_outage_ns", 0) * 1e-9
    return "less than a second" if outage_s < 1.0 else format_duration(outage_s)

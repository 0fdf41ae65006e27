# SPDX-License-Identifier: Apache-2.0
"""What ``status`` and ``top`` say of prefetching: what was fetched ahead, and how much of it was used."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

__all__ = ["over_fetch", "prefetch_as_json", "prefetch_words"]

COUNTS: Final = (
    "prefetch_misses",
    "prefetch_started",
    "prefetch_used",
    "prefetch_in_vain",
    "prefetch_overtaken",
    "bytes_prefetched",
)


def over_fetch(counters: Mapping[str, int]) -> float | None:
    """Return bytes loaded by bytes that were handed out at least once; None before the first.

    What was fetched ahead and not used yet counts as loaded only.  The ratio is below 1 after a warm start,
    when segments that the previous run loaded are handed out.
    """
    used = counters.get("bytes_used", 0)
    return counters.get("bytes_loaded", 0) / used if used else None


def prefetch_as_json(counters: Mapping[str, int]) -> dict[str, object]:
    """Return the setting, the storage's outages and the counters of prefetching, for programs."""
    ratio = over_fetch(counters)
    return {
        "outage_tolerance_s": counters.get("outage_tolerance_ns", 0) * 1e-9,
        "origin_out": bool(counters.get("origin_out", 0)),
        "last_outage_s": round(counters.get("last_outage_ns", 0) * 1e-9, 3),
        **{name: counters.get(name, 0) for name in COUNTS},
        "over_fetch": None if ratio is None else round(ratio, 4),
    }


def prefetch_words(counters: Mapping[str, int]) -> list[tuple[str, bool]]:
    """Return short texts, each with whether it is a problem; none while prefetching has nothing to do."""
    misses, lately = counters.get("prefetch_misses", 0), counters.get("prefetch_misses_1min", 0)
    if not (counters.get("prefetch_started") or misses):
        return []
    words = [
        (f"{counters['prefetch_started']:,} fetched ahead", False),
        (f"{counters['prefetch_used']:,} then asked for", False),
        (f"{counters['prefetch_in_vain']:,} in vain", False),
        (f"prefetch misses {misses:,} ({lately:,} in 1 min)", lately > 0),
    ]
    if (ratio := over_fetch(counters)) is not None:
        words.append((f"loaded {ratio:.2f} times what was used", False))
    return words

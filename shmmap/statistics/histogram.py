# SPDX-License-Identifier: Apache-2.0
"""Histograms of durations whose buckets any reader can compute: four to an octave, from 1 us to 73 min.

Bucket 0 counts what is below 2^10 ns.  Bucket ``1 + 4 (e - 10) + s`` counts what lies in
``[2^e (1 + s/4), 2^e (1 + (s + 1)/4))`` ns, for e in 10 … 41 and s in 0 … 3.  The last bucket counts
what is 2^42 ns and longer.  A bucket is at most a quarter wider than its lower bound, and finding it
takes no logarithm.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

__all__ = ["BUCKETS", "FIRST_EXPONENT", "STEPS", "Histogram", "bucket_of", "lower_bound_ns"]

FIRST_EXPONENT: Final = 10
LAST_EXPONENT: Final = 42
STEPS: Final = 4
BUCKETS: Final = 2 + STEPS * (LAST_EXPONENT - FIRST_EXPONENT)


def bucket_of(duration_ns: int) -> int:
    """Return the index of the bucket that counts a duration."""
    exponent = duration_ns.bit_length() - 1
    if exponent < FIRST_EXPONENT or duration_ns < 0:
        return 0
    if exponent >= LAST_EXPONENT:
        return BUCKETS - 1
    # the two bits below the leading one are the quarter of the octave
    return 4 * (exponent - FIRST_EXPONENT) + (duration_ns >> (exponent - 2)) - 3


def lower_bound_ns(bucket: int) -> int:
    """Return the shortest duration a bucket counts; it is where the bucket before it ends."""
    if bucket <= 0:
        return 0
    octave, step = divmod(bucket - 1, STEPS)
    return (STEPS + step) << (FIRST_EXPONENT + octave - 2)


class Histogram(NamedTuple):
    """Durations counted since the daemon started.

    Attributes
    ----------
    sum_ns
        All of them together.
    counts
        How many fell in each bucket.
    """

    sum_ns: int = 0
    counts: tuple[int, ...] = (0,) * BUCKETS

    @property
    def total(self) -> int:
        """How many there are."""
        return sum(self.counts)

    def quantile_s(self, share: float) -> float | None:
        """Return the duration in seconds that ``share`` of all do not exceed; None when there is none.

        Within a bucket they are taken to be spread evenly, so that it is right to an eighth or so; of the
        last bucket only the lower bound is known.
        """
        total = self.total
        if not total:
            return None
        wanted = share * total
        before = 0
        for bucket, count in enumerate(self.counts):
            if count and before + count >= wanted:
                low = lower_bound_ns(bucket)
                high = lower_bound_ns(bucket + 1) if bucket + 1 < len(self.counts) else low
                return (low + (high - low) * max(wanted - before, 0.0) / count) * 1e-9
            before += count
        return lower_bound_ns(len(self.counts) - 1) * 1e-9

    def since(self, earlier: Histogram) -> Histogram:
        """Return what was counted after ``earlier``, a state of the same histogram."""
        counts = tuple(new - old for new, old in zip(self.counts, earlier.counts, strict=True))
        return Histogram(self.sum_ns - earlier.sum_ns, counts)

    @classmethod
    def of(cls, values: Sequence[int]) -> Histogram:
        """Make one of the sum and the counts as they lie in a segment."""
        return cls(values[0], tuple(values[1:]))

# SPDX-License-Identifier: Apache-2.0
"""Buckets tile the durations without gaps, and quantiles are right to a bucket."""

from __future__ import annotations

import random

from hypothesis import given
from hypothesis import strategies as st

from shmmap.statistics.counters import BUCKETS, Histogram, bucket_of, lower_bound_ns


def counted(durations: list[int]) -> Histogram:
    counts = [0] * BUCKETS
    for duration in durations:
        counts[bucket_of(duration)] += 1
    return Histogram(sum(durations), tuple(counts))


@given(st.integers(0, 2**44))
def test_a_duration_lies_in_its_bucket(duration: int) -> None:
    bucket = bucket_of(duration)
    assert lower_bound_ns(bucket) <= duration
    if bucket + 1 < BUCKETS:
        assert duration < lower_bound_ns(bucket + 1)


def test_edges() -> None:
    assert [bucket_of(n) for n in (-5, 0, 1023, 1024, 1279, 1280, 2047, 2048)] == [0, 0, 0, 1, 1, 2, 4, 5]
    assert bucket_of(2**42 - 1) == BUCKETS - 2
    assert bucket_of(2**42) == bucket_of(2**60) == BUCKETS - 1
    bounds = [lower_bound_ns(bucket) for bucket in range(BUCKETS)]
    assert bounds == sorted(set(bounds))
    assert bounds[:3] == [0, 1024, 1280]
    assert bounds[-1] == 2**42
    assert all(bucket_of(bound) == bucket for bucket, bound in enumerate(bounds))


def test_quantiles_are_right_to_an_eighth() -> None:
    generator = random.Random(5)
    durations = sorted(int(generator.lognormvariate(13, 1.5)) + 2000 for _ in range(20_000))
    histogram = counted(durations)
    for share in (0.01, 0.5, 0.9, 0.99, 0.999):
        found = histogram.quantile_s(share)
        assert found is not None
        exact = durations[int(share * len(durations))] * 1e-9
        assert abs(found - exact) < 0.125 * exact, share


def test_nothing_counted_has_no_quantile() -> None:
    assert Histogram().quantile_s(0.5) is None


def test_what_came_since() -> None:
    first, second = counted([2000, 3000]), counted([2000, 3000, 2**50])
    assert second.since(first) == counted([2**50])
    assert second.since(first).quantile_s(0.5) == 2**42 * 1e-9

# SPDX-License-Identifier: Apache-2.0
"""The line search: ends where it should, and where PCL and ndt_omp differ does as each of them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from shmmap_clients.ndt_scan_matcher.matching.more_thuente import MAX_TRIALS, line_search

KINK = 0.00024


def kink(a: float) -> tuple[float, float]:
    """Value and slope of a valley with steep, nearly straight sides; lowest at `KINK`."""
    length = math.hypot(a - KINK, KINK / 50)
    return length, (a - KINK) / length


def trials(*, by_upper_end: bool, first: float = 0.1) -> list[float]:
    """Step lengths that were looked at, in order."""
    search = line_search(first, 1e-9, 0.1, *kink(0.0), by_upper_end=by_upper_end)
    seen = [next(search)]

    def to_the_end() -> None:
        while True:
            seen.append(search.send(kink(seen[-1])))

    with pytest.raises(StopIteration) as ended:
        to_the_end()
    assert ended.value.value == (seen[-1], len(seen) - 1)
    return seen


def lowest_between(a: float, b: float) -> float:
    """Minimiser of the cubic through values and slopes at both."""
    (fa, ga), (fb, gb) = kink(a), kink(b)
    rows = [[1, a, a**2, a**3], [1, b, b**2, b**3], [0, 1, 2 * a, 3 * a**2], [0, 1, 2 * b, 3 * b**2]]
    cubic = np.polynomial.Polynomial(np.linalg.solve(rows, [fa, fb, ga, gb]))
    return next(float(r.real) for r in cubic.deriv().roots() if cubic.deriv(2)(r.real) > 0)


def test_a_good_first_step_is_taken() -> None:
    for by_upper_end in (False, True):
        assert trials(by_upper_end=by_upper_end, first=KINK) == [KINK]


def test_where_pcl_goes_on_from_the_other_end() -> None:
    ours, theirs = (trials(by_upper_end=by_upper_end) for by_upper_end in (False, True))
    same = next(n for n, (a, b) in enumerate(zip(ours, theirs, strict=False)) if a != b)
    lower = ours[same - 1]
    assert kink(lower)[0] < kink(0.0)[0]  # the last trial is the best so far: the lower end, with 0 the upper
    assert kink(lower)[1] > 0.9 * -kink(0.0)[1]  # but too steep to end there
    assert theirs[same] == pytest.approx(lowest_between(0.0, lower), rel=1e-6)
    assert ours[same] == pytest.approx(
        lower + 0.66 * (0.0 - lower), rel=1e-9
    )  # what is left without the cubic
    assert max(len(ours), len(theirs)) <= MAX_TRIALS + 1

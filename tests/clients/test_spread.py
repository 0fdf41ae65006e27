# SPDX-License-Identifier: Apache-2.0
"""Numbers of a stream of any length, in bounded memory."""

from __future__ import annotations

import numpy as np
import pytest
from shmmap_clients.spread import KEPT, Decimated, RunningSpread


def test_few_numbers_are_all_kept() -> None:
    running = RunningSpread()
    assert np.isnan(running.spread.mean)
    assert np.isnan(running.root_mean_square)
    values = np.random.default_rng(0).normal(3.0, 2.0, KEPT)
    for value in values:
        running.add(value)
    spread = running.spread
    assert spread.mean == pytest.approx(values.mean())
    assert spread.variance == pytest.approx(values.var())
    assert [spread.p50, spread.p99] == np.percentile(values, (50, 99)).tolist()
    assert spread.max == values.max()
    assert running.root_mean_square == pytest.approx(np.sqrt((values**2).mean()))


def test_many_numbers_keep_their_distribution() -> None:
    running = RunningSpread()
    values = np.random.default_rng(1).exponential(1.0, 50_000)
    values[777] = 100.0  # not among those kept, and still the maximum
    for value in values:
        running.add(value)
    spread = running.spread
    assert running.count == 50_000
    assert len(running._sample.values) <= KEPT
    assert spread.mean == pytest.approx(values.mean())
    assert spread.variance == pytest.approx(values.var())
    assert spread.max == 100.0
    p50, p99 = np.percentile(values, (50, 99))
    assert spread.p50 == pytest.approx(p50, rel=0.05)
    assert spread.p99 == pytest.approx(p99, rel=0.1)


@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 100, 1000])
def test_decimated_values_are_evenly_from_the_whole_stream(count: int) -> None:
    kept: Decimated[int] = Decimated(8)
    for value in range(count):
        kept.add(value)
    assert len(kept.values) <= 8
    if count:
        stride = kept.values[1] if count > 1 else 1
        assert kept.values == list(range(0, count, stride))
        assert len(kept.values) >= min(count, 4)

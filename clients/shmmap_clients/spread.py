# SPDX-License-Identifier: Apache-2.0
"""Streams of any length in bounded memory: a sample of values, and the distribution of numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Generic, TypeVar

import numpy as np

KEPT: Final = 4096

T = TypeVar("T")


class Decimated(Generic[T]):
    """Sample of a stream: all values up to ``most``, then every second, fourth, eighth, ... one.

    Parameters
    ----------
    most
        Largest number of kept values; at least 2.
    """

    def __init__(self, most: int = KEPT) -> None:
        self._most = most
        self._stride = 1
        self._count = 0
        self.values: list[T] = []

    def add(self, value: T) -> None:
        """Add the next value of the stream."""
        if self._count % self._stride == 0:
            if len(self.values) == self._most:
                del self.values[1::2]
                self._stride *= 2
            if self._count % self._stride == 0:
                self.values.append(value)
        self._count += 1


@dataclass(frozen=True, slots=True)
class Spread:
    """Distribution of numbers; NaN if there are none."""

    mean: float
    variance: float
    p50: float
    p99: float
    max: float


class RunningSpread:
    """Running distribution of numbers, in constant memory.

    Mean, variance and maximum are over all numbers (Welford 1962).  So are percentiles of short streams; for
    longer ones they are over thousands of numbers, evenly from the whole stream (`Decimated`).
    """

    def __init__(self) -> None:
        self.count = 0
        self._mean = 0.0
        self._squares = 0.0  # sum of squared distances from the mean
        self._max = -math.inf
        self._sample: Decimated[float] = Decimated()

    def add(self, value: float) -> None:
        """Add a number."""
        self.count += 1
        before = value - self._mean
        self._mean += before / self.count
        self._squares += before * (value - self._mean)
        self._max = max(self._max, value)
        self._sample.add(value)

    @property
    def spread(self) -> Spread:
        """Spread of the numbers so far."""
        if not self.count:
            return Spread(*(math.nan,) * 5)
        p50, p99 = np.percentile(self._sample.values, (50, 99))
        return Spread(self._mean, self._squares / self.count, float(p50), float(p99), self._max)

    @property
    def root_mean_square(self) -> float:
        """Root mean square of the numbers so far; NaN if there are none."""
        return math.sqrt(self._mean**2 + self._squares / self.count) if self.count else math.nan

    @property
    def document(self) -> dict[str, float] | None:
        """Median, 99th percentile and maximum, for JSON; None if there are no numbers."""
        spread = self.spread
        return {"p50": spread.p50, "p99": spread.p99, "max": spread.max} if self.count else None

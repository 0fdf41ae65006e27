# SPDX-License-Identifier: Apache-2.0
"""A slow origin: how long each load takes, and when none succeeds."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

__all__ = ["OUTAGES", "SIGMA", "Outages", "SlowOrigin"]

SIGMA = 0.8
"""Standard deviation of the logarithm of a load's time: one in twenty takes 2.7 times the mean or longer."""


class Outages(NamedTuple):
    """For ``length_s`` in every ``period_s`` no load succeeds; the first time at ``first_s``."""

    length_s: float
    period_s: float
    first_s: float

    @property
    def up(self) -> float:
        """Share of time in which loads succeed."""
        return 1.0 - self.length_s / self.period_s

    def meets(self, begin_s: float, end_s: float) -> bool:
        """Whether an outage falls into this time, both ends included."""
        if not self.length_s:
            return False
        last_begun_s = self.first_s + math.floor((end_s - self.first_s) / self.period_s) * self.period_s
        return last_begun_s >= self.first_s and begin_s <= last_begun_s + self.length_s


OUTAGES = {
    "none": Outages(0.0, 120.0, 0.0),
    "10 s / 120 s": Outages(10.0, 120.0, 120.0),
    "60 s / 300 s": Outages(60.0, 300.0, 300.0),
}


@dataclass(eq=False, slots=True)
class SlowOrigin:
    """Log-normal load times of a given mean, each load's own; the same for the same seed.

    Attributes
    ----------
    mean_s
        Mean time of a load, seconds.
    outages
        A load that is under way or begun in one fails; it takes its time all the same.
    """

    mean_s: float
    outages: Outages
    seed: int = 0
    _random: np.random.Generator = field(init=False)

    def __post_init__(self) -> None:
        self._random = np.random.Generator(np.random.PCG64([self.seed, 16]))

    def took_s(self) -> float:
        """How long the next load takes."""
        # the mean of a log-normal distribution is exp(mu + sigma^2 / 2)
        return float(self._random.lognormal(math.log(self.mean_s) - 0.5 * SIGMA * SIGMA, SIGMA))

    def load(self, now_s: float) -> tuple[float, bool]:
        """Begin a load: when it ends, and whether it fails."""
        end_s = now_s + self.took_s()
        return end_s, self.outages.meets(now_s, end_s)

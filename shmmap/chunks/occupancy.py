# SPDX-License-Identifier: Apache-2.0
"""Occupancy model: selection of points, log-odds of hits and misses, thresholds of occupied and free.

A voxel holds log-odds in thousandths, ``int16(1000 * ln(p / (1 - p)))`` truncated towards zero, between two
clamps; 0 is *unknown*.  A hit adds, a miss subtracts (Bonxai's ``ProbabilisticMap`` does the same in
millionths).  A known voxel whose evidence becomes exactly 0 is unknown again.
"""

from __future__ import annotations

import math
from typing import Final

import msgspec

from shmmap.errors import ConfigError

UNIT: Final = 1000
NEAREST: Final = 1e-9
"""Minimum distance of a probability from 0 and 1; beyond that its log-odds do not fit."""


def log_odds(probability: float) -> int:
    """Return log-odds in thousandths, truncated towards zero."""
    return int(UNIT * math.log(probability / (1.0 - probability)))


def probability(log_odds: float) -> float:
    """Return the probability for log-odds in thousandths."""
    return 1.0 / (1.0 + math.exp(-log_odds / UNIT))


class Occupancy(msgspec.Struct, frozen=True):
    """Parameters of the occupancy update, fixed when a map is created; all are probabilities.

    The defaults are those of Rolling-Bonxai's parameter file.

    Attributes
    ----------
    hit, miss
        Probability of occupancy after one hit (above a half) and one miss (below a half).
    clamp_min, clamp_max
        Bounds of every voxel's probability.  (Rolling-Bonxai calls them ``m_occupancy_min_thresh`` and
        ``max``.)
    occupied_above, free_below
        Thresholds above which a voxel counts as occupied, and below which as free.

    Raises
    ------
    ConfigError
        A value is no probability, is on the wrong side of a half, or makes a hit or miss add nothing.
    """

    hit: float = 0.7
    miss: float = 0.4
    clamp_min: float = 0.12
    clamp_max: float = 0.97
    occupied_above: float = 0.5
    free_below: float = 0.5

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            value = getattr(self, name)
            if not NEAREST <= value <= 1.0 - NEAREST:
                raise ConfigError(f"{name} = {value!r}: need a probability between 0 and 1", key=name)
        for name, upward in (("hit", True), ("clamp_max", True), ("miss", False), ("clamp_min", False)):
            value = getattr(self, name)
            worth = log_odds(value)
            if (worth > 0) != upward or worth == 0:
                side = "above" if upward else "below"
                raise ConfigError(f"{name} = {value!r}: need more than 0.0005 {side} 0.5", key=name)
        for name, right in (
            ("occupied_above", 0.5 <= self.occupied_above < self.clamp_max),
            ("free_below", self.clamp_min < self.free_below <= 0.5),
        ):
            if not right:
                value = getattr(self, name)
                raise ConfigError(f"{name} = {value!r}: it must lie between 0.5 and the clamp", key=name)

    @property
    def steps(self) -> tuple[int, int, int, int]:
        """Hit, miss, lower and upper clamp, as log-odds in thousandths."""
        return log_odds(self.hit), log_odds(self.miss), log_odds(self.clamp_min), log_odds(self.clamp_max)

    @property
    def thresholds(self) -> tuple[int, int]:
        """Log-odds above which a voxel is occupied, and below which it is free, thousandths."""
        return log_odds(self.occupied_above), log_odds(self.free_below)


class ScanFilter(msgspec.Struct, frozen=True):
    """Selects the points of a scan to use; metres, in the sensor's frame.

    The defaults are those of Rolling-Bonxai's parameter file.

    Attributes
    ----------
    min_range, max_range
        Nearer points are left out; rays to further ones are cut at ``max_range`` and end in nothing.
    min_z, max_z
        Points below and above are left out.

    Raises
    ------
    ConfigError
        A minimum is not below its maximum, or a value is not a finite number.
    """

    min_range: float = 0.5
    max_range: float = 5.0
    min_z: float = -2.0
    max_z: float = 2.0

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            value = getattr(self, name)
            if not math.isfinite(value):
                raise ConfigError(f"{name} = {value!r}: need a finite number of metres", key=name)
        if self.min_range < 0.0:
            raise ConfigError(f"min_range = {self.min_range!r}: it must not be negative", key="min_range")
        for least, most in (("min_range", "max_range"), ("min_z", "max_z")):
            low, high = getattr(self, least), getattr(self, most)
            if not low < high:
                raise ConfigError(f"{most} = {high!r}: need more than {least} = {low!r}", key=most)


class ScanCounts(msgspec.Struct, frozen=True):
    """Numbers of points of a scan: in range, cut at the maximum range, and left out for each reason."""

    near: int
    far: int
    too_near: int
    outside_z: int
    not_finite: int

# SPDX-License-Identifier: Apache-2.0
"""Which points of a scan count, and what became of them."""

from __future__ import annotations

import math

import msgspec

from shmmap.errors import ConfigError

__all__ = ["ScanCounts", "ScanFilter"]


class ScanFilter(msgspec.Struct, frozen=True):
    """Which points of a scan count; metres, in the sensor's frame.

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
        Nothing lies between two of them, or one is no finite number.
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
    """What became of a scan's points: in range, cut at the greatest range, and left out for what reason."""

    near: int
    far: int
    too_near: int
    outside_z: int
    not_finite: int

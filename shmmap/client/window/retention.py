# SPDX-License-Identifier: Apache-2.0
"""Decide which cells a window keeps attached after they have left it; pure functions, without a clock.

A kept cell occupies memory that the daemon could reuse, and saves attaching it again
(tens of microseconds) or loading it again (milliseconds) when the vehicle turns back.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import msgspec

from shmmap.errors import BadRequest


class RetentionCandidate(NamedTuple):
    """A cell outside the window that is still attached.

    ``distance`` is from the present pose to the nearest point of its box, metres; ``nbytes`` is its size;
    ``age`` is the time since it left, seconds.
    """

    distance: float
    nbytes: int
    age: float


class RetentionPolicy(Protocol):
    """Policy that a window applies after each answer of the daemon."""

    def keep(self, departed: Sequence[RetentionCandidate]) -> Sequence[bool]:
        """Return, for each departed cell, whether to keep it."""


class Retention(msgspec.Struct, frozen=True):
    """Policy that keeps cells within limits of distance, total bytes and age, nearest first.

    Parameters
    ----------
    distance
        Metres from the pose to the nearest point of the cell; the default 0 keeps nothing.
    max_bytes
        Limit for the total size of the kept cells.  Cells are kept in order of distance while they fit: a
        nearer cell is never dropped for a farther one.
    max_age
        Seconds since the cell left the window.

    Raises
    ------
    BadRequest
        A limit is negative or not a number.
    """

    distance: float = 0.0
    max_bytes: float = math.inf
    max_age: float = math.inf

    def __post_init__(self) -> None:
        for name in ("distance", "max_bytes", "max_age"):
            value: float = getattr(self, name)
            if not value >= 0:
                raise BadRequest(f"retention: {name} must not be negative, it is {value!r}")

    def keep(self, departed: Sequence[RetentionCandidate]) -> list[bool]:
        """Return, for each departed cell, whether to keep it."""
        kept = [False] * len(departed)
        if not self.distance:
            return kept
        left = self.max_bytes
        for index in sorted(range(len(departed)), key=lambda i: (departed[i].distance, departed[i].age)):
            cell = departed[index]
            if cell.distance > self.distance:
                break
            if cell.age > self.max_age:
                continue
            left -= cell.nbytes
            if left < 0:
                break
            kept[index] = True
        return kept

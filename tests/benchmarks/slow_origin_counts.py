# SPDX-License-Identifier: Apache-2.0
"""What came of a drive beside a slow origin: queries that waited, late cells, cells fetched."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

__all__ = ["Counts", "Query"]


@dataclass(slots=True)
class Query:
    """One time that the client asks for its area: which cells lack, and until when."""

    asked_s: float
    x: float
    y: float
    new: int
    late: int
    lacking: set[int]
    stall_s: float = 0.0
    fetched: int = 0
    used: int = 0
    ahead: int = 0


@dataclass(slots=True)
class Counts:
    """What came of a drive.

    Attributes
    ----------
    queries
        All of them.
    full_s
        From when they count: the way ahead was in memory for the first time.
    fetched, used
        Loads that succeeded, and those of them that were asked for before they gave way.
    no_room
        How often nothing was fetched ahead for want of memory.
    """

    queries: list[Query] = field(default_factory=list)
    full_s: float = math.inf
    fetched: int = 0
    used: int = 0
    no_room: int = 0

    @property
    def counted(self) -> list[Query]:
        """Queries that count."""
        return [query for query in self.queries if query.asked_s >= self.full_s]

    @property
    def warm(self) -> float:
        """Share of queries that lacked nothing."""
        return sum(not query.late for query in self.counted) / max(1, len(self.counted))

    @property
    def late(self) -> int:
        """Cells that were not there when they were first needed."""
        return sum(query.late for query in self.counted)

    @property
    def over_fetch(self) -> float:
        """Cells fetched for each that was used."""
        return self.fetched / max(1, self.used)

    def stall_s(self, *percent: float) -> list[float]:
        """Percentiles of the time until all of an area is there, seconds."""
        found: list[float] = np.percentile([query.stall_s for query in self.counted], percent).tolist()
        return found

    @property
    def new_per_s(self) -> float:
        """Cells that come into the area in a second."""
        counted = self.counted
        return sum(query.new for query in counted) / max(1e-9, counted[-1].asked_s - counted[0].asked_s)

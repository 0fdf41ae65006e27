# SPDX-License-Identifier: Apache-2.0
"""A slow origin (how long each load takes, and when none succeeds), and what came of a drive beside it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

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

    def next_s(self, now_s: float) -> float:
        """Return when the present outage began, or the next one begins; infinity if there are none."""
        if not self.length_s:
            return math.inf
        last_s = self.first_s + math.floor((now_s - self.first_s) / self.period_s) * self.period_s
        if now_s < self.first_s:
            return self.first_s
        return last_s if now_s < last_s + self.length_s else last_s + self.period_s

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
        A load that is running or begun in one fails; it takes its time all the same.
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


SILENCE_S = 4.0
"""Silence after which a load over a link fails: a server that is silent for 2 s is asked once more."""


@dataclass(eq=False, slots=True)
class ThinLink:
    """A link that carries one object after the other, in the order in which they were asked for.

    Attributes
    ----------
    mbit_s, delay_s
        Its rate, 10^6 bits a second, and the time until an answer begins if nothing is before it.
    object_bytes
        Bytes of each object.
    outages
        Nothing passes in one; an object that waits in one for longer than `SILENCE_S` fails, and is lost.
    """

    mbit_s: float
    delay_s: float
    object_bytes: int
    outages: Outages
    carried_bytes: float = 0.0
    _free_s: float = 0.0
    _on_it: list[tuple[float, float]] = field(default_factory=list)
    _taken_s: float = 0.0

    @property
    def object_s(self) -> float:
        """Time that an object takes."""
        return self.object_bytes * 8e-6 / self.mbit_s

    def load(self, now_s: float) -> tuple[float, bool]:
        """Ask for an object: when that ends, and whether it fails."""
        begin_s = max(self._free_s, now_s + self.delay_s)
        end_s, out_s = begin_s + self.object_s, self.outages.next_s(now_s)
        if out_s < end_s:
            back_s = out_s + self.outages.length_s
            since_s = max(now_s, out_s)
            if back_s > since_s + SILENCE_S:
                return since_s + SILENCE_S, True
            begin_s = max(begin_s, back_s)
            end_s = begin_s + self.object_s
        self._free_s = end_s
        self._on_it.append((begin_s, end_s))
        return end_s, False

    def take_bytes(self, now_s: float) -> int:
        """Return the bytes that have come since the last call."""
        share = 0.0
        for begin_s, end_s in self._on_it:
            share += max(0.0, min(end_s, now_s) - max(begin_s, self._taken_s)) / (end_s - begin_s)
        self._on_it = [one for one in self._on_it if one[1] > now_s]
        self._taken_s = now_s
        self.carried_bytes += share * self.object_bytes
        return round(share * self.object_bytes)


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
    """What came of a drive.  They count from ``full_s``: the path ahead was in memory for the first time."""

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

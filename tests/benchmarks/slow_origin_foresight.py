# SPDX-License-Identifier: Apache-2.0
"""What is fetched before it is asked for: nothing, a margin, what the daemon's policy says, or the truth."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from shmmap.daemon.loading.look_ahead import OriginHealth, Prefetch, Reader, Wish
from shmmap.daemon.map.catalogue_view import CatalogueView
from shmmap.daemon.travel.motion import Motion
from shmmap.geometry import Circle

IsAbsent = Callable[[int, str], bool]
MARGIN_M = 60.0


class Nothing:
    """What is asked for is fetched, and nothing else; to the daemon's scheduler `Prefetch` is the same."""

    def __init__(self) -> None:
        self.health = OriginHealth()
        self.more = False

    def asks(self, area: Circle) -> None:
        """The client asks for an area: nothing follows from it."""

    def next(self, catalogue: CatalogueView, now_s: float) -> Wish | None:
        """Return what is to be fetched: nothing."""
        del catalogue, now_s
        return None

    def next_s(self, now_s: float) -> float:
        """When to ask again though nothing happens: never."""
        del now_s
        return math.inf

    def note_origin(self, now_s: float) -> None:
        """Note whether the origin is out: nothing depends on it."""


class Margin(Nothing):
    """What lies around the area asked for, nearest first."""

    def __init__(self, is_absent: IsAbsent) -> None:
        super().__init__()
        self._is_absent = is_absent
        self._area: Circle | None = None
        self._cells: list[int] = []

    def asks(self, area: Circle) -> None:
        """Look around that next time."""
        self._area = area

    def next(self, catalogue: CatalogueView, now_s: float) -> Wish | None:
        """Return the nearest that is absent."""
        if now_s < self.health.next_try_s():
            return None
        if self._area is not None:
            x, y, radius = self._area.x, self._area.y, self._area.radius + MARGIN_M
            cells = catalogue.query(Circle(x, y, radius))[0]
            middles = catalogue.boxes_of(cells).reshape(-1, 2, 2).mean(axis=1)
            self._cells = cells[np.argsort(-np.hypot(*(middles - (x, y)).T))].tolist()
            self._area = None
        while self._cells:
            cell = self._cells.pop()
            if self._is_absent(cell, "points"):
                self.health.tried(now_s)
                return Wish(cell, "points", 0.0)
        return None


class Truth(Nothing):
    """What will be asked for, in that order, as far ahead as the policy looks.

    Parameters
    ----------
    future
        (T,) when cells come into the area, ascending, and (T,) which.
    """

    def __init__(
        self,
        is_absent: IsAbsent,
        outage_tolerance_s: float,
        future: tuple[NDArray[np.float64], NDArray[np.intp]],
    ) -> None:
        super().__init__()
        self._is_absent = is_absent
        self._policy = Prefetch(is_absent, outage_tolerance_s)
        self._policy.health = self.health
        self._times_s, self._cells = future

    def next(self, catalogue: CatalogueView, now_s: float) -> Wish | None:
        """Return what is asked for first of what is absent."""
        del catalogue
        if now_s < self.health.next_try_s():
            return None
        begin, end = np.searchsorted(self._times_s, [now_s, now_s + self._policy.look_ahead.route_s])
        for at in range(begin, end):
            if self._is_absent(int(self._cells[at]), "points"):
                self.health.tried(now_s)
                return Wish(int(self._cells[at]), "points", float(self._times_s[at] - now_s))
        return None

    def next_s(self, now_s: float) -> float:
        """Something comes into sight all the time."""
        return now_s + 0.1


class Policy(Nothing):
    """The daemon's own."""

    def __init__(self, is_absent: IsAbsent, outage_tolerance_s: float, motion: Motion, area: Circle) -> None:
        super().__init__()
        self._prefetch, self._reader = Prefetch(is_absent, outage_tolerance_s), Reader(is_absent)
        self._prefetch.health = self.health
        self._motion = motion
        self.asks(area)

    def note_origin(self, now_s: float) -> None:
        """As the daemon does when loads end."""
        self._prefetch.note_origin(now_s)

    def asks(self, area: Circle) -> None:
        """Go on from there."""
        self._prefetch.follow("client", self._motion, area, ("points",))

    def next(self, catalogue: CatalogueView, now_s: float) -> Wish | None:
        """Return what the daemon would fetch next."""
        wish = self._prefetch.next(catalogue, now_s, self._reader)
        self.more = self._prefetch.next_s(now_s, self._reader) <= now_s
        return wish

    def next_s(self, now_s: float) -> float:
        """When the daemon would look again."""
        return self._prefetch.next_s(now_s, self._reader)

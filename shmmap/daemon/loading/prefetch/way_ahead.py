# SPDX-License-Identifier: Apache-2.0
"""Which cells one client will ask for next, nearest in time first; without any I/O.

The area that a client asks for is moved along its way, a step at a time: cells that come into it at a step
are needed when the client is there.  The way is the route that the client told; without one, and beyond its
end, straight on and, a little later, to both sides of that, because nobody knows where it turns; the longer
it has come straight on, the farther.  What it will ask for along a kilometre is not kept: the way is looked
over again and again (a *pass*), and what is not in memory is wished for.  So a wish is never out of date,
whatever moves, changes or gives way meanwhile.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shmmap.daemon.loading.loads import PREFETCH
from shmmap.daemon.map.catalogue_view import CatalogueView
from shmmap.daemon.travel.motion import Motion
from shmmap.geometry import Area

__all__ = ["PASS_S", "LookAhead", "WayAhead"]

PASS_S: Final = 2.0
"""How often the way is looked over from its beginning."""
SLOWEST_MPS: Final = 0.5
"""A client that is slower stands; without a route, nobody knows where it will go."""
MOST_AHEAD_M: Final = 5000.0
MOST_CELLS: Final = 20_000
"""Of an area with more cells nothing is fetched ahead."""
SPREAD_RAD: Final = 0.5
"""So far to both sides of straight on a client without a route is taken to turn."""
LATER_S: Final = 1.0
"""So much later than what lies straight on is fetched what lies to the sides."""
STRAIGHT_M: Final = 500.0
"""Few streets of a town are so long: for each metre that one has come straight on beyond it, another one
ahead is looked at."""
BESIDE_M: Final = 2.0
"""So far to either side of the way told a client may be: what is told is the middle of a lane."""


class LookAhead(NamedTuple):
    """How many seconds ahead is looked: along a way told; where none is known straight on; to its sides."""

    way_s: float
    straight_s: float
    sides_s: float


@dataclass(eq=False, slots=True)
class WayAhead:
    """One client's way.

    Attributes
    ----------
    motion
        How it moves; somebody keeps it up to date.
    area, layers
        What it asked for last, and of what kind.
    ahead_m
        How far ahead the pass has come.
    over
        Whether it has come to the end of what is looked at.
    """

    motion: Motion
    area: Area
    layers: tuple[str, ...]
    ahead_m: float = 0.0
    over: bool = True
    began_s: float = -math.inf
    _inside: NDArray[np.intp] | None = None
    _travelled_m: float = 0.0
    _jumps: int = -1
    _found: deque[tuple[float, int]] = field(default_factory=deque)

    def asks(self, area: Area, layers: tuple[str, ...]) -> None:
        """The client asked for this."""
        self.area, self.layers = area, layers

    @property
    def pace_s(self) -> float:
        """Seconds that the client takes for a metre: as fast as it was of late it may soon be again."""
        return 1.0 / max(self.motion.fastest_mps, SLOWEST_MPS)

    @property
    def moves(self) -> bool:
        """Whether it is known where the client will be."""
        motion = self.motion
        return (motion.fastest_mps if motion.route is not None else motion.speed_mps) >= SLOWEST_MPS

    def begin(self, now_s: float) -> None:
        """Begin another pass."""
        self.began_s, self.ahead_m, self.over = now_s, 0.0, False
        self._inside = None
        self._found.clear()
        self._travelled_m, self._jumps = self.motion.travelled_m, self.motion.jumps

    def first(self) -> tuple[float, int] | None:
        """What is needed next of what was found: in how many seconds, and its index; None if all is taken."""
        if not self._found or self.has_jumped:
            return None
        ahead_m, index = self._found[0]
        return max(ahead_m - self.motion.travelled_m, 0.0) * self.pace_s, index

    @property
    def has_jumped(self) -> bool:
        """Whether the client is somewhere else than where the pass began."""
        return self._jumps != self.motion.jumps

    def take(self) -> None:
        """The first one is seen to."""
        self._found.popleft()

    def look(self, catalogue: CatalogueView, ahead: LookAhead, step_m: float) -> None:
        """Go a step further along the way."""
        motion = self.motion
        if self.has_jumped:
            self.begin(self.began_s)
        moved_m, self._travelled_m = motion.travelled_m - self._travelled_m, motion.travelled_m
        self.ahead_m = max(0.0, self.ahead_m - moved_m)
        end_m = self._end_m(ahead)
        if self.ahead_m >= end_m or not self.moves:
            self.over = True
            return
        if self._inside is None:
            self._inside = self._known(catalogue, self.area, 0.0)
        if len(self._inside) > MOST_CELLS:
            self.over = True
            return
        here_m, self.ahead_m = self.ahead_m, min(self.ahead_m + step_m, end_m)
        inside = self._around(catalogue, self.ahead_m, self.ahead_m * self.pace_s <= ahead.sides_s)
        new = np.setdiff1d(inside, self._inside, assume_unique=True)
        needed_m = motion.travelled_m + here_m
        self._found.extend((needed_m, index) for index in new.tolist())
        self._inside = inside

    def _known(self, catalogue: CatalogueView, area: Area, needed_in_s: float) -> NDArray[np.intp]:
        """Cells of an area; pages that may have others are fetched, too, and those that are here are kept."""
        found, _known = catalogue.query(area, MOST_CELLS)
        if (pages := catalogue.pages) is not None and not catalogue.complete:
            pages.want(pages.of_area(area), PREFETCH + needed_in_s)
        return found

    def looks_s(self, ahead: LookAhead) -> float:
        """How many seconds ahead is looked."""
        if self.motion.route is not None:
            return ahead.way_s
        return max(ahead.straight_s, min((self.motion.straight_m - STRAIGHT_M) * self.pace_s, ahead.way_s))

    def _end_m(self, ahead: LookAhead) -> float:
        """How far ahead is looked."""
        speed = 1.0 / self.pace_s
        if self.motion.route is None:
            return min(speed * self.looks_s(ahead), MOST_AHEAD_M)
        known_m = min(speed * ahead.way_s, self._left_m)
        return min(max(known_m, speed * ahead.sides_s), MOST_AHEAD_M)

    @property
    def _left_m(self) -> float:
        """How long the way is that the client told."""
        route = self.motion.route
        return 0.0 if route is None else route.length_m - self.motion.along_m

    @property
    def _wider_m(self) -> float:
        """Nobody drives in the very middle of the way."""
        return BESIDE_M if self.motion.route is not None else 0.0

    def _around(self, catalogue: CatalogueView, ahead_m: float, sides: bool) -> NDArray[np.intp]:
        """Cells that the client may need when it has come so far, to the sides of where nobody knows, too."""
        motion, left_m = self.motion, self._left_m
        x, y, heading = motion.x, motion.y, math.atan2(motion.vy, motion.vx)
        if motion.route is not None:
            x, y = motion.route.at(motion.along_m + ahead_m).tolist()
            heading = motion.route.last_heading
        beyond_m = max(ahead_m - left_m, 0.0)
        ways = [(heading, beyond_m)]
        if sides and beyond_m:
            side_m = max(0.0, beyond_m - LATER_S / self.pace_s)
            ways += [(heading + SPREAD_RAD, side_m), (heading - SPREAD_RAD, side_m)]
        areas = [
            self.area.around(x + far_m * math.cos(angle), y + far_m * math.sin(angle), self._wider_m)
            for angle, far_m in ways
        ]
        found = [self._known(catalogue, area, ahead_m * self.pace_s) for area in areas]
        return found[0] if len(found) == 1 else np.unique(np.concatenate(found))

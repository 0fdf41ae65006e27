# SPDX-License-Identifier: Apache-2.0
"""Which cells one client will ask for next, nearest in time first; without any I/O.

The area that a client asks for is moved along its way, a step at a time: cells that come into it at a step are
needed when the client is there.  The way is the route that the client told; without one, and beyond its end,
straight on and to both sides of that, because nobody knows where it turns.  What it will ask for along a kilometre is not
kept: the way is looked over again and again (a *pass*), and what is not in memory is wished for.  So a wish
is never out of date, whatever moves, changes or gives way meanwhile.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap.daemon.map.catalogue_view import CatalogueView
from shmmap.daemon.travel.motion import Motion
from shmmap.geometry import Area

__all__ = ["PASS_S", "WayAhead"]

PASS_S: Final = 2.0
"""How often the way is looked over from its beginning."""
SLOWEST_MPS: Final = 0.5
"""A client that is slower stands; without a route, nobody knows where it will go."""
MOST_AHEAD_M: Final = 5000.0
MOST_CELLS: Final = 20_000
"""Of an area with more cells nothing is fetched ahead."""
SPREAD_RAD: Final = 0.5
"""So far to both sides of straight on a client without a route may turn."""
SIDES_S: Final = 8.0
"""To the sides, and beyond a route's end, it is looked ahead so long only: much of it is fetched in vain."""
_NONE: Final = np.empty(0, np.intp)


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
    needed_per_m
        How many cells come into the area for each metre that the client moves.
    """

    motion: Motion
    area: Area
    layers: tuple[str, ...]
    ahead_m: float = 0.0
    over: bool = True
    began_s: float = -math.inf
    needed_per_m: float = 0.0
    _inside: NDArray[np.intp] | None = None
    _travelled_m: float = 0.0
    _jumps: int = -1
    _found: deque[tuple[float, int]] = field(default_factory=deque)
    _entered: tuple[float, int] = (0.0, 0)

    def asks(self, area: Area, layers: tuple[str, ...]) -> None:
        """The client asked for this."""
        self.area, self.layers = area, layers

    @property
    def pace_s(self) -> float:
        """Seconds that the client takes for a metre."""
        return 1.0 / max(self._speed_mps, SLOWEST_MPS)

    @property
    def _speed_mps(self) -> float:
        motion = self.motion
        return motion.fastest_mps if motion.route is not None else motion.speed_mps

    @property
    def moves(self) -> bool:
        """Whether it is known where the client will be."""
        return self._speed_mps >= SLOWEST_MPS

    def begin(self, now_s: float) -> None:
        """Begin another pass."""
        self.began_s, self.ahead_m, self.over = now_s, 0.0, False
        self._inside = None
        self._found.clear()
        self._travelled_m, self._jumps = self.motion.travelled_m, self.motion.jumps
        if self._entered[0]:
            self.needed_per_m = self._entered[1] / self._entered[0]
        self._entered = (0.0, 0)

    def first(self) -> tuple[float, int] | None:
        """What is needed next of what was found: in how many seconds, and its index; None where all was taken."""
        if not self._found:
            return None
        ahead_m, index = self._found[0]
        return max(ahead_m - self.motion.travelled_m, 0.0) * self.pace_s, index

    def take(self) -> None:
        """The first one is seen to."""
        self._found.popleft()

    def look(self, catalogue: CatalogueView, look_ahead_s: float, step_m: float) -> None:
        """Go a step further along the way."""
        motion = self.motion
        if self._jumps != motion.jumps:
            self.begin(self.began_s)
        moved_m, self._travelled_m = motion.travelled_m - self._travelled_m, motion.travelled_m
        self.ahead_m = max(0.0, self.ahead_m - moved_m)
        end_m = self._end_m(look_ahead_s)
        if self.ahead_m >= end_m or not self.moves:
            self.over = True
            return
        if self._inside is None:
            self._inside, _ = catalogue.query(self.area, MOST_CELLS)
        if len(self._inside) > MOST_CELLS:
            self.over = True
            return
        here_m, self.ahead_m = self.ahead_m, min(self.ahead_m + step_m, end_m)
        inside = self._around(catalogue, self.ahead_m)
        new = np.setdiff1d(inside, self._inside, assume_unique=True)
        needed_m = motion.travelled_m + here_m
        self._found.extend((needed_m, index) for index in new.tolist())
        metres, cells = self._entered
        self._entered = metres + self.ahead_m - here_m, cells + len(new)
        self._inside = inside

    def _end_m(self, look_ahead_s: float) -> float:
        """How far ahead is looked."""
        speed = self._speed_mps
        end_m = min(speed * look_ahead_s, MOST_AHEAD_M)
        return end_m if self.motion.route is None else min(end_m, max(self._left_m, speed * SIDES_S))

    @property
    def _left_m(self) -> float:
        """How long the way is that the client told."""
        route = self.motion.route
        return 0.0 if route is None else route.length_m - self.motion.along_m

    def _around(self, catalogue: CatalogueView, ahead_m: float) -> NDArray[np.intp]:
        """Cells that the client may need when it has come so far."""
        motion, left_m = self.motion, self._left_m
        x, y, heading = motion.x, motion.y, math.atan2(motion.vy, motion.vx)
        if motion.route is not None:
            x, y = motion.route.at(motion.along_m + ahead_m).tolist()
            heading = motion.route.last_heading
        beyond_m = max(ahead_m - left_m, 0.0)
        both = beyond_m > 0.0 and ahead_m * self.pace_s <= SIDES_S
        found = [
            catalogue.query(
                self.area.around(x + beyond_m * math.cos(angle), y + beyond_m * math.sin(angle)), MOST_CELLS
            )[0]
            for angle in ((heading, heading + SPREAD_RAD, heading - SPREAD_RAD) if both else (heading,))
        ]
        return found[0] if len(found) == 1 else np.unique(np.concatenate(found))

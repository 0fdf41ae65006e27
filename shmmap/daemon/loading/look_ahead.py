# SPDX-License-Identifier: Apache-2.0
"""Which cell is fetched next before a client asks: of all clients' paths, what is needed first; no I/O.

The area that a client asks for is moved along its path, a step at a time: cells that come into it at a step
are needed when the client is there.  The path is the route that the client sent; without one, and beyond its
end, straight ahead and, a little later, to both sides of that, because it is unknown where the client turns;
the longer it has come straight ahead, the farther.  What it will ask for along a kilometre is not kept: the
path is looked over again and again (a *pass*), and what is not in memory is wished for.  So a wish is never
out of date, whatever moves, changes or is evicted meanwhile.

`Prefetcher` asks for a wish when no demand waits for a loader (`Prefetch.next`), and reports how loads ended.
How far ahead is looked, in seconds of travel, is the longest time without the origin that is to be bridged,
and what a load takes, slow ones included.  Where the path is unknown, an outage is prepared for only after
there was one, or on a long straight: much of that is fetched in vain.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shmmap.daemon.loading.loads import PREFETCH
from shmmap.daemon.map.catalogue_view import CatalogueView
from shmmap.daemon.travel.motion import Motion
from shmmap.geometry import Area

__all__ = [
    "PASS_S",
    "URGENT_S",
    "LookAhead",
    "OriginHealth",
    "Prefetch",
    "WayAhead",
    "Wish",
]


LOADS: Final = 64
"""Loads that the estimate of their time is made of."""
IN_A_ROW: Final = 4
"""So many loads that failed, one after the other, are no matter of single files."""
PROBE_S: Final = 0.5
"""How often it is then tried whether one succeeds."""


@dataclass(eq=False, slots=True)
class OriginHealth:
    """What loads tell of their origin.

    Attributes
    ----------
    failed_in_a_row
        Loads that failed since the last one that succeeded.
    waited_s
        The longest that one of these took, seconds: about how long nothing has answered.
    unreachable
        It is known otherwise that it does not answer.
    slow_s
        Time that few of the last loads exceeded (5 %); 0 before the first.
    """

    failed_in_a_row: int = 0
    waited_s: float = 0.0
    unreachable: bool = False
    slow_s: float = 0.0
    _took_s: deque[float] = field(default_factory=lambda: deque(maxlen=LOADS))
    _tried_s: float = -math.inf

    @property
    def is_out(self) -> bool:
        """Whether nothing can be loaded just now."""
        return self.unreachable or self.failed_in_a_row >= IN_A_ROW

    def next_try_s(self) -> float:
        """Until when nothing is tried; minus infinity unless nothing can be loaded.

        Loads may succeed although the origin does not answer: from the disk.
        """
        return self._tried_s + PROBE_S if self.is_out and self.failed_in_a_row else -math.inf

    def tried(self, now_s: float) -> None:
        """A load begins."""
        self._tried_s = now_s

    def ended(self, took_s: float, *, failed: bool) -> bool:
        """A load ended; whether that tells that loads succeed again, after they did not."""
        if failed:
            self.failed_in_a_row += 1
            self.waited_s = max(self.waited_s, took_s)
            return False
        again, self.failed_in_a_row, self.waited_s = self.is_out, 0, 0.0
        self._took_s.append(took_s)
        ordered = sorted(self._took_s)
        self.slow_s = ordered[(len(ordered) * 19) // 20]
        return again


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


COMPARED_AT_ONCE: Final = 64
"""Ways, and cells on them, that are compared at a time: for a wish of more clients it takes some turns."""
LOOKS_AT_ONCE: Final = 2
"""Steps along clients' ways that are looked at for one wish: a fifth of a millisecond."""
SLOW_LOADS: Final = 1.6
"""So many, one after the other, a cell may have to wait for."""
SLACK_S: Final = 3.0
"""Beside all that is measured: requests come a step of the window apart, and so do looks along the way."""
SPARE: Final = 1.25
"""What was used up in an outage comes back slowly; until it has, cells come just in time or a little late."""
AFTER_S: Final = 2.0
"""Until loads are known to succeed again after they did not, and the first ones have come."""
GUESSED_S: Final = 10.0
"""Nobody goes straight on for longer than this."""
URGENT_S: Final = 2.0
"""What is needed sooner is a demand in all but name: it takes the loader, too, that is kept for those."""
SHORTEST_STEP_M: Final = 5.0


class Wish(NamedTuple):
    """One layer of a cell that somebody will ask for."""

    cell: int
    layer: str
    needed_in_s: float


class Prefetch:
    """Chooses what is fetched ahead.

    Parameters
    ----------
    is_absent
        Whether a layer of a cell, by index, is neither in memory nor being loaded, and may be tried.
    outage_tolerance_s
        For so long the origin may be away without anybody's noticing.

    Attributes
    ----------
    ways : dict
        Clients' ways, by whom.
    health
        What loads tell of the origin.
    more : bool
        Whether asking again at once may bring a wish, though the last time brought none.
    """

    def __init__(self, is_absent: Callable[[int, str], bool], outage_tolerance_s: float) -> None:
        self._is_absent = is_absent
        self._outage_tolerance_s = outage_tolerance_s
        self._catalogue: CatalogueView | None = None
        self.ways: dict[Hashable, WayAhead] = {}
        self.health = OriginHealth()
        self.more = False
        self._out_since_s = math.inf
        self._away_s = 0.0
        self._left: list[WayAhead] = []  # not compared yet for the next wish
        self._behind: WayAhead | None = None  # of those compared: known least far
        self._chosen: WayAhead | None = None  # ... and what is needed first, and whose it is
        self._best: Wish | None = None

    @property
    def look_ahead(self) -> LookAhead:
        """How far ahead is looked: what comes into reach later is not wished for yet."""
        load_s = SLOW_LOADS * self.health.slow_s + SLACK_S
        way_s = load_s + SPARE * self._outage_tolerance_s + PASS_S + AFTER_S
        straight_s = load_s + min(self._outage_tolerance_s, self._away_s, GUESSED_S)
        return LookAhead(way_s, straight_s, load_s)

    def next(self, catalogue: CatalogueView, now_s: float) -> Wish | None:
        """Return what is needed first of what is absent; None if nothing is, or not known yet (`more`)."""
        self.more = False
        is_back = self._is_back(now_s)
        if is_back or catalogue is not self._catalogue:
            self._left = []
            # indices mean other cells now, or what was passed over because it had failed may be tried
            self._catalogue = catalogue
            for way in self.ways.values():
                way.begin(now_s)
        if now_s < self.health.next_try_s():
            return None
        step_m = max(SHORTEST_STEP_M, 0.5 * min(catalogue.mean_size))
        for _ in range(LOOKS_AT_ONCE):
            if not self._compare_some(now_s):
                self.more = True
                return None
            behind, chosen, wish = self._behind, self._chosen, self._best
            if wish is not None and (behind is None or behind is chosen or not _is_before(behind, wish)):
                if self._is_absent(wish.cell, wish.layer):
                    self.health.tried(now_s)
                    return wish
            elif behind is None:
                return None
            else:
                behind.look(catalogue, self.look_ahead, step_m)
        self.more = True
        return None

    def restart(self) -> None:
        """Begin all paths from the start: more of the map on them is known now."""
        self._catalogue = None

    def _compare_some(self, now_s: float) -> bool:
        """Look at some ways: which is known least far, which has the first wish; True after the last."""
        if not self._left:
            self._left = list(self.ways.values())
            self._behind = self._chosen = self._best = None
        for _ in range(COMPARED_AT_ONCE):
            if not self._left:
                return True
            way = self._left[-1]
            self._begin_if_due(way, now_s)
            if (first := way.first()) is not None:
                needed_in_s, index = first
                absent = [layer for layer in way.layers if self._is_absent(index, layer)]
                if not absent:
                    way.take()
                    continue
                if self._best is None or needed_in_s < self._best.needed_in_s:
                    self._chosen, self._best = way, Wish(index, absent[0], needed_in_s)
            least = self._behind
            if not way.over and (least is None or way.ahead_m * way.pace_s < least.ahead_m * least.pace_s):
                self._behind = way
            self._left.pop()
        return not self._left

    def _is_back(self, now_s: float) -> bool:
        """Whether loads succeed again; and for how long they did not."""
        if self.health.is_out:
            # a silent server is noticed late: it was already away when the failed loads began
            self._out_since_s = min(self._out_since_s, now_s - self.health.waited_s)
            return False
        if self._out_since_s == math.inf:
            return False
        away_s, self._out_since_s = now_s - self._out_since_s, math.inf
        if away_s > SLACK_S:  # a single lost answer does not show how long outages are
            self._away_s = max(away_s, 0.5 * self._away_s)
        return True

    def _begin_if_due(self, way: WayAhead, now_s: float) -> None:
        """Have a way looked over again, if it is time."""
        due = now_s - way.began_s >= PASS_S and (way.over or way.first() is not None)
        if way.moves and (due or way.has_jumped):
            way.begin(now_s)

    def next_s(self, now_s: float) -> float:
        """When to ask again though nothing happens."""
        if not any(way.moves for way in self.ways.values()):
            return math.inf
        if self.health.is_out:
            return self.health.next_try_s()
        return min(way.began_s + PASS_S if way.over else now_s for way in self.ways.values() if way.moves)


def _is_before(way: WayAhead, wish: Wish) -> bool:
    """Whether a way that is still looked over may have a wish before this one."""
    return way.ahead_m * way.pace_s < wish.needed_in_s

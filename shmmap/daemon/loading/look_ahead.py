# SPDX-License-Identifier: Apache-2.0
"""Choice of the cell to prefetch next: on all clients' paths, the one needed first; without any I/O.

The area that a client asks for is moved along its path in steps: cells that enter it at a step are needed
when the client arrives there.  The path is the route that the client sent.  Without a route, and beyond its
end, the path continues straight ahead and, a little later, to both sides, because the client may turn; the
longer the client has moved straight ahead, the farther.  Cells needed along a kilometre are not stored: the
path is examined repeatedly (a *pass*), and absent cells become wishes.  So no wish is ever outdated, whatever
moves, changes or is evicted in the meantime.

`Prefetcher` asks for a wish when no demand waits for a loader (`Prefetch.next`), and reports how loads ended.
The look-ahead, in seconds of travel, is the longest outage of the origin to be bridged plus the time of a
load, slow loads included.  Where the path is unknown, the daemon prepares for an outage only after one has
occurred, or on a long straight: most of those cells would be fetched in vain.
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

LOADS: Final = 64
"""Number of recent loads from which the time of a load is estimated."""
IN_A_ROW: Final = 4
"""Consecutive failed loads after which the origin, not single files, is taken to be the cause."""
PROBE_S: Final = 0.5
"""Interval of trying one load while the origin is out."""


@dataclass(eq=False, slots=True)
class OriginHealth:
    """State of the origin, inferred from loads and other signs.

    Attributes
    ----------
    failed_in_a_row
        Loads that failed since the last success.
    waited_s
        Duration of the longest of these, seconds: roughly how long the origin has not answered.
    unreachable
        Whether another check found that the origin does not answer.
    slow_s
        95th percentile of the durations of recent loads, seconds; 0 before the first.
    """

    failed_in_a_row: int = 0
    waited_s: float = 0.0
    unreachable: bool = False
    slow_s: float = 0.0
    _took_s: deque[float] = field(default_factory=lambda: deque(maxlen=LOADS))
    _tried_s: float = -math.inf

    @property
    def is_out(self) -> bool:
        """Whether no load can succeed at present."""
        return self.unreachable or self.failed_in_a_row >= IN_A_ROW

    def next_try_s(self) -> float:
        """Time before which nothing is tried; minus infinity unless loads fail at present.

        Loads from the disk may succeed although the origin does not answer.
        """
        return self._tried_s + PROBE_S if self.is_out and self.failed_in_a_row else -math.inf

    def answers(self) -> None:
        """Note that the origin answers."""
        self.failed_in_a_row, self.waited_s = 0, 0.0

    def tried(self, now_s: float) -> None:
        """Note that a load was begun."""
        self._tried_s = now_s

    def ended(self, took_s: float, *, failed: bool) -> bool:
        """Note the end of a load; return whether loads succeed again after an outage."""
        if failed:
            self.failed_in_a_row += 1
            self.waited_s = max(self.waited_s, took_s)
            return False
        again = self.is_out
        self.answers()
        self._took_s.append(took_s)
        ordered = sorted(self._took_s)
        self.slow_s = ordered[(len(ordered) * 19) // 20]
        return again


PASS_S: Final = 2.0
"""Interval at which a path is examined from its beginning."""
SLOWEST_MPS: Final = 0.5
"""A slower client counts as standing; without a route its path is unknown."""
MAX_AHEAD_M: Final = 5000.0
MAX_CELLS: Final = 20_000
"""Limit of an area's cells: for a larger area nothing is prefetched."""
SPREAD_RAD: Final = 0.5
"""Largest turn to either side that is assumed for a client without a route."""
LATER_S: Final = 1.0
"""Extra delay of cells to the sides compared with cells straight ahead."""
LONG_STRAIGHT_M: Final = 500.0
"""Length of a straight, longer than most streets of a town, beyond which each metre that a client has moved
straight ahead extends the look-ahead by a metre."""
BESIDE_M: Final = 2.0
"""Allowed lateral distance of a client from its route, which is the middle of a lane: the area is wider."""


class LookAhead(NamedTuple):
    """Look-ahead in seconds: along a route; straight ahead without a route; to the sides of the path."""

    route_s: float
    straight_s: float
    sides_s: float


@dataclass(eq=False, slots=True)
class ClientPath:
    """One client's path, and the current pass over it.

    Attributes
    ----------
    motion
        How the client moves, kept up to date by its session.
    area, layers
        Last requested area and layers.
    ahead_m
        Distance that the pass has examined so far, metres.
    is_done
        Whether the pass has reached the end of the look-ahead.
    """

    motion: Motion
    area: Area
    layers: tuple[str, ...]
    ahead_m: float = 0.0
    is_done: bool = True
    began_s: float = -math.inf
    _inside: NDArray[np.intp] | None = None
    _travelled_m: float = 0.0
    _jumps: int = -1
    _found: deque[tuple[float, int]] = field(default_factory=deque)

    @property
    def pace_s(self) -> float:
        """Time that the client takes per metre at its greatest recent speed, seconds."""
        return 1.0 / max(self.motion.fastest_mps, SLOWEST_MPS)

    @property
    def moves(self) -> bool:
        """Whether the client moves, so that its future positions are known."""
        motion = self.motion
        return (motion.fastest_mps if motion.route is not None else motion.speed_mps) >= SLOWEST_MPS

    def begin(self, now_s: float) -> None:
        """Begin another pass."""
        self.began_s, self.ahead_m, self.is_done = now_s, 0.0, False
        self._inside = None
        self._found.clear()
        self._travelled_m, self._jumps = self.motion.travelled_m, self.motion.jumps

    def first(self) -> tuple[float, int] | None:
        """Return the cell found in this pass that is needed next: seconds until then, and its index."""
        if not self._found or self.has_jumped:
            return None
        ahead_m, index = self._found[0]
        return max(ahead_m - self.motion.travelled_m, 0.0) * self.pace_s, index

    @property
    def has_jumped(self) -> bool:
        """Whether the client's position has jumped since the pass began."""
        return self._jumps != self.motion.jumps

    def take(self) -> None:
        """Drop the cell that `first` returns."""
        self._found.popleft()

    def look(self, catalogue: CatalogueView, ahead: LookAhead, step_m: float) -> None:
        """Examine the next step along the path."""
        motion = self.motion
        if self.has_jumped:
            self.begin(self.began_s)
        moved_m, self._travelled_m = motion.travelled_m - self._travelled_m, motion.travelled_m
        self.ahead_m = max(0.0, self.ahead_m - moved_m)
        end_m = self._end_m(ahead)
        if self.ahead_m >= end_m or not self.moves:
            self.is_done = True
            return
        if self._inside is None:
            self._inside = self._known(catalogue, self.area, 0.0)
        if len(self._inside) > MAX_CELLS:
            self.is_done = True
            return
        here_m, self.ahead_m = self.ahead_m, min(self.ahead_m + step_m, end_m)
        inside = self._around(catalogue, self.ahead_m, self.ahead_m * self.pace_s <= ahead.sides_s)
        new = np.setdiff1d(inside, self._inside, assume_unique=True)
        needed_m = motion.travelled_m + here_m
        self._found.extend((needed_m, index) for index in new.tolist())
        self._inside = inside

    def _known(self, catalogue: CatalogueView, area: Area, needed_in_s: float) -> NDArray[np.intp]:
        """Return the known cells of an area; request missing pages of it, and keep its loaded ones."""
        found, _known = catalogue.query(area, MAX_CELLS)
        if (pages := catalogue.pages) is not None and not catalogue.complete:
            pages.want(pages.of_area(area), PREFETCH + needed_in_s)
        return found

    def looks_s(self, ahead: LookAhead) -> float:
        """Return the look-ahead in seconds."""
        if self.motion.route is not None:
            return ahead.route_s
        return max(
            ahead.straight_s, min((self.motion.straight_m - LONG_STRAIGHT_M) * self.pace_s, ahead.route_s)
        )

    def _end_m(self, ahead: LookAhead) -> float:
        """Return the look-ahead in metres."""
        speed = 1.0 / self.pace_s
        if self.motion.route is None:
            return min(speed * self.looks_s(ahead), MAX_AHEAD_M)
        known_m = min(speed * ahead.route_s, self._left_m)
        return min(max(known_m, speed * ahead.sides_s), MAX_AHEAD_M)

    @property
    def _left_m(self) -> float:
        """Remaining length of the route ahead of the client, metres."""
        route = self.motion.route
        return 0.0 if route is None else route.length_m - self.motion.along_m

    def _around(self, catalogue: CatalogueView, ahead_m: float, sides: bool) -> NDArray[np.intp]:
        """Return cells that the client may need after this distance; with ``sides`` also beside the path."""
        motion, left_m = self.motion, self._left_m
        x, y, heading, wider_m = motion.x, motion.y, math.atan2(motion.vy, motion.vx), 0.0
        if motion.route is not None:
            wider_m = BESIDE_M
            x, y = motion.route.at(motion.along_m + ahead_m).tolist()
            heading = motion.route.last_heading
        beyond_m = max(ahead_m - left_m, 0.0)
        rays = [(heading, beyond_m)]
        if sides and beyond_m:
            side_m = max(0.0, beyond_m - LATER_S / self.pace_s)
            rays += [(heading + SPREAD_RAD, side_m), (heading - SPREAD_RAD, side_m)]
        areas = [
            self.area.around(x + far_m * math.cos(angle), y + far_m * math.sin(angle), wider_m)
            for angle, far_m in rays
        ]
        found = [self._known(catalogue, area, ahead_m * self.pace_s) for area in areas]
        return found[0] if len(found) == 1 else np.unique(np.concatenate(found))


COMPARED_PER_TURN: Final = 64
"""Paths, and cells on them, compared in one call; with more clients, choosing a wish takes several turns."""
LOOKS_PER_WISH: Final = 2
"""Steps along paths examined for one wish: a fifth of a millisecond."""
SLOW_LOADS: Final = 1.6
"""Consecutive loads that a cell may have to wait for."""
SLACK_S: Final = 3.0
"""Margin added to the measured times, since requests and steps along the path are discrete."""
SPARE: Final = 1.25
"""Factor on the outage's duration: cells used up in one outage are replaced only slowly."""
AFTER_S: Final = 2.0
"""Time until loads are known to succeed again after an outage, and the first cells have arrived."""
GUESSED_S: Final = 10.0
"""Longest time for which a client without a route is assumed to move straight ahead."""
URGENT_S: Final = 2.0
"""A cell needed sooner counts as a demand: it may also use the loader places kept free for demands."""
SHORTEST_STEP_M: Final = 5.0


class Wish(NamedTuple):
    """One layer of a cell that a client will ask for."""

    cell: int
    layer: str
    needed_in_s: float


class Prefetch:
    """Chooses the cells to prefetch.

    Parameters
    ----------
    is_absent
        Whether a layer of a cell, by index, is neither in memory nor being loaded, and may be loaded.
    outage_tolerance_s
        Duration of an outage of the origin that clients must not notice, seconds.

    Attributes
    ----------
    paths : dict
        Paths by client.
    health
        State of the origin.
    more : bool
        Whether asking again at once may return a wish although the last call returned none.
    """

    def __init__(
        self,
        is_absent: Callable[[int, str], bool],
        outage_tolerance_s: float,
        health: OriginHealth | None = None,
    ) -> None:
        self._is_absent = is_absent
        self._outage_tolerance_s = outage_tolerance_s
        self._catalogue: CatalogueView | None = None
        self.paths: dict[Hashable, ClientPath] = {}
        self.health = health or OriginHealth()
        self.more = False
        self._out_since_s = math.inf
        self._away_s = 0.0
        self._uncompared: list[ClientPath] = []  # paths not compared yet for the next wish
        self._behind: ClientPath | None = None  # among the compared paths: the one examined least far
        self._chosen: ClientPath | None = None  # ... and the one with the earliest wish
        self._best: Wish | None = None

    def follow(self, client: Hashable, motion: Motion, area: Area, layers: tuple[str, ...]) -> None:
        """Prefetch for a client, given its motion and its last requested area and layers."""
        path = self.paths.get(client)
        if path is None or path.motion is not motion:
            self.paths[client] = ClientPath(motion, area, layers)
        else:
            path.area, path.layers = area, layers

    def follow_like(self, other: Prefetch) -> None:
        """Prefetch for the same clients as ``other``."""
        for client in self.paths.keys() - other.paths.keys():
            del self.paths[client]
        for client, path in other.paths.items():
            self.follow(client, path.motion, path.area, path.layers)

    @property
    def look_ahead(self) -> LookAhead:
        """Current look-ahead; cells beyond it are not wished for yet."""
        load_s = SLOW_LOADS * self.health.slow_s + SLACK_S
        route_s = load_s + SPARE * self._outage_tolerance_s + PASS_S + AFTER_S
        straight_s = load_s + min(self._outage_tolerance_s, self._away_s, GUESSED_S)
        return LookAhead(route_s, straight_s, load_s)

    def next(self, catalogue: CatalogueView, now_s: float) -> Wish | None:
        """Return the absent cell that is needed first; None if there is none, or none known yet (`more`)."""
        self.more = False
        is_back = self._is_back(now_s)
        if is_back or catalogue is not self._catalogue:
            self._uncompared = []
            # indices mean other cells now, or cells skipped for a failure may be tried
            self._catalogue = catalogue
            for path in self.paths.values():
                path.begin(now_s)
        if now_s < self.health.next_try_s():
            return None
        step_m = max(SHORTEST_STEP_M, 0.5 * min(catalogue.mean_size))
        for _ in range(LOOKS_PER_WISH):
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
        """Begin all paths from the start: more of the map along them is known now."""
        self._catalogue = None

    def _compare_some(self, now_s: float) -> bool:
        """Compare some paths for the least examined one and the earliest wish; return True after the last."""
        if not self._uncompared:
            self._uncompared = list(self.paths.values())
            self._behind = self._chosen = self._best = None
        for _ in range(COMPARED_PER_TURN):
            if not self._uncompared:
                return True
            path = self._uncompared[-1]
            due = now_s - path.began_s >= PASS_S and (path.is_done or path.first() is not None)
            if path.moves and (due or path.has_jumped):
                path.begin(now_s)
            if (first := path.first()) is not None:
                needed_in_s, index = first
                absent = [layer for layer in path.layers if self._is_absent(index, layer)]
                if not absent:
                    path.take()
                    continue
                if self._best is None or needed_in_s < self._best.needed_in_s:
                    self._chosen, self._best = path, Wish(index, absent[0], needed_in_s)
            least = self._behind
            if not path.is_done and (
                least is None or path.ahead_m * path.pace_s < least.ahead_m * least.pace_s
            ):
                self._behind = path
            self._uncompared.pop()
        return not self._uncompared

    def note_origin(self, now_s: float) -> None:
        """Note whether the origin is out, also while no wish may begin."""
        if self.health.is_out:
            # loads fail after a delay: the server was already silent when they began
            self._out_since_s = min(self._out_since_s, now_s - self.health.waited_s)

    def _is_back(self, now_s: float) -> bool:
        """Whether loads succeed again after an outage; note how long the outage was."""
        self.note_origin(now_s)
        if self.health.is_out or self._out_since_s == math.inf:
            return False
        away_s, self._out_since_s = now_s - self._out_since_s, math.inf
        if away_s > SLACK_S:  # a single lost answer does not show how long outages are
            self._away_s = max(away_s, 0.5 * self._away_s)
        return True

    def next_s(self, now_s: float) -> float:
        """Return when to ask again if nothing happens until then."""
        if not any(path.moves for path in self.paths.values()):
            return math.inf
        if self.health.is_out:
            return self.health.next_try_s()
        return min(
            path.began_s + PASS_S if path.is_done else now_s for path in self.paths.values() if path.moves
        )


def _is_before(path: ClientPath, wish: Wish) -> bool:
    """Whether an unfinished pass over a path may still find an earlier wish than the given one."""
    return path.ahead_m * path.pace_s < wish.needed_in_s

# SPDX-License-Identifier: Apache-2.0
"""Which cell is fetched next: on all clients' paths, the one needed first; without any I/O.

The area that a client asks for is moved along its path in steps: cells that enter it at a step are needed
when the client arrives there.  The path is the route that the client sent.  Without a route, and beyond its
end, the path continues straight ahead and, a little later, to both sides, because the client may turn; the
longer the client has moved straight ahead, the farther.  All paths are looked along again and again, some
steps at a time, and what is missing is listed in the order in which it is needed.  Whether a cell is still
missing is asked again when its turn comes.  With many clients the paths are looked along less often, and
farther.

The list has two readers: `shmmap.daemon.loading.prefetcher`, into memory, when no demand waits for a loader,
and `shmmap.daemon.loading.outages`, onto the disk.  The look-ahead, in seconds of travel, is the longest
outage of the origin to be bridged plus the time of a load, slow loads included.  Where the path is unknown,
the daemon prepares for an outage only after one has occurred, or on a long straight: most of those cells
would be fetched in vain.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import product
from operator import attrgetter
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shmmap.daemon.loading.loads import PREFETCH
from shmmap.daemon.map.catalogue_view import CatalogueView
from shmmap.daemon.travel.motion import Motion
from shmmap.daemon.travel.places import WORK_S
from shmmap.geometry import Area, Box
from shmmap.origin.spatial_index import touches

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
    """

    failed_in_a_row: int = 0
    waited_s: float = 0.0
    unreachable: bool = False
    _took_s: deque[float] = field(default_factory=lambda: deque(maxlen=LOADS))
    _tried_s: float = -math.inf

    @property
    def slow_s(self) -> float:
        """95th percentile of the durations of recent loads, seconds; 0 before the first."""
        ordered = sorted(self._took_s)
        return ordered[len(ordered) * 19 // 20] if ordered else 0.0

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
        return again


PASS_S: Final = 1.0
"""Shortest interval at which all paths are looked along."""
LOOK_WORK: Final = 8000
"""Work of finding the cells around a part of a path."""
CELL_WORK: Final = 150
"""Work of asking whether a cell is missing."""
STEPS_TOGETHER: Final = 8
"""Steps along a path for which the cells around are found together; fewer where cells are many."""
ASKED_TOGETHER: Final = 64
"""Cells of a step along a path that are asked for together."""
MAX_LISTED: Final = 1024
"""Cells listed if there are more than twice as many: those needed first."""
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
    """One client's path.

    Attributes
    ----------
    motion
        How the client moves, kept up to date by its session.
    area, layers
        Last requested area and layers.
    jumps
        Number of jumps of its position, as of the last `Prefetch.follow`.
    work
        Work of looking along it so far.
    """

    motion: Motion
    area: Area
    layers: tuple[str, ...]
    jumps: int = -1
    work: int = 0
    _together: int = 1

    @property
    def pace_s(self) -> float:
        """Time that the client takes per metre at its greatest recent speed, seconds."""
        return 1.0 / max(self.motion.fastest_mps, SLOWEST_MPS)

    @property
    def moves(self) -> bool:
        """Whether the client moves, so that its future positions are known."""
        motion = self.motion
        return (motion.fastest_mps if motion.route is not None else motion.speed_mps) >= SLOWEST_MPS

    def look(
        self, catalogue: CatalogueView, ahead: LookAhead, step_m: float
    ) -> Iterator[tuple[float, list[int]]]:
        """Look along the path: yield for each step in how many seconds which cells come into the area."""
        here_m, end_m = 0.0, self._end_m(ahead) if self.moves else 0.0
        last: list[Area] = [self.area]
        while here_m < end_m:
            marks_m = [min(here_m + step_m * number, end_m) for number in range(1, self._together + 1)]
            marks_m = marks_m[: math.ceil((end_m - here_m) / step_m)]
            steps = [last, *self._areas(marks_m, ahead.sides_s)]
            cells, inside = self._cells_inside(catalogue, steps, here_m * self.pace_s)
            if np.count_nonzero(inside[0]) > MAX_CELLS:
                return
            for number, before_m in enumerate([here_m, *marks_m[:-1]], 1):
                new = cells[inside[number] & ~inside[number - 1]].tolist()
                for begin in range(0, max(1, len(new)), ASKED_TOGETHER):
                    yield before_m * self.pace_s, new[begin : begin + ASKED_TOGETHER]
            here_m, last = marks_m[-1], steps[-1]
            self._together = max(1, min(STEPS_TOGETHER, MAX_CELLS // max(1, len(cells))))

    def _cells_inside(
        self, catalogue: CatalogueView, steps: Sequence[Sequence[Area]], needed_in_s: float
    ) -> tuple[NDArray[np.intp], list[NDArray[np.bool_]]]:
        """Return known cells, and for each step which of them are in its areas; request missing pages."""
        areas = [area for step in steps for area in step]
        if (pages := catalogue.pages) is not None and not catalogue.complete:
            for area in areas:
                pages.want(pages.of_area(area), PREFETCH + needed_in_s)
        bounds = np.array([area.bounds for area in areas])
        around = Box(*bounds[:, :2].min(axis=0).tolist(), *bounds[:, 2:].max(axis=0).tolist())
        cells, _known = catalogue.query(around, 2 * MAX_CELLS)
        boxes = np.asfortranarray(catalogue.boxes_of(cells))
        self.work += LOOK_WORK + len(cells) * len(areas)
        return cells, [np.logical_or.reduce([touches(area, boxes) for area in step]) for step in steps]

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

    def _areas(self, marks_m: Sequence[float], sides_s: float) -> Iterator[list[Area]]:
        """Yield the areas that the client may need after each distance; at first also beside the path."""
        motion, left_m = self.motion, self._left_m
        heading, wider_m, at = math.atan2(motion.vy, motion.vx), 0.0, [(motion.x, motion.y)] * len(marks_m)
        if motion.route is not None:
            heading, wider_m = motion.route.last_heading, BESIDE_M
            at = motion.route.at(motion.along_m + np.array(marks_m)).tolist()
        for ahead_m, (x, y) in zip(marks_m, at, strict=True):
            beyond_m = max(ahead_m - left_m, 0.0)
            rays = [(heading, beyond_m)]
            if ahead_m * self.pace_s <= sides_s and beyond_m:
                side_m = max(0.0, beyond_m - LATER_S / self.pace_s)
                rays += [(heading + SPREAD_RAD, side_m), (heading - SPREAD_RAD, side_m)]
            yield [
                self.area.around(x + far_m * math.cos(angle), y + far_m * math.sin(angle), wider_m)
                for angle, far_m in rays
            ]


READ_PER_CALL: Final = 64
"""Cells of the list that one call passes over because they are not missing any more."""
WORK_PER_CALL: Final = 10_000
"""Work after which a call ends: a quarter of a millisecond."""
SLOW_LOADS: Final = 1.6
"""Consecutive loads that a cell may have to wait for."""
SLACK_S: Final = 2.5
"""Margin added to the measured times, since requests and steps along the path are discrete."""
SPARE: Final = 1.25
"""Factor on the outage's duration: cells used up in one outage are replaced only slowly."""
AFTER_S: Final = 4.5
"""Time until loads are known to succeed again after an outage, paths are looked along, and the first cells
have arrived."""
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


class _Listed(NamedTuple):
    """A layer of a cell that a client will ask for at a time, unless its position jumps."""

    needed_s: float
    cell: int
    layer: str
    client: Hashable
    jumps: int


@dataclass(eq=False, slots=True)
class Reader:
    """A reader of the list.

    Attributes
    ----------
    lacks
        Whether it lacks a layer of a cell, by index, and may fetch it.
    """

    lacks: Callable[[int, str], bool]
    listed: Sequence[_Listed] = ()
    read: int = 0


class Prefetch:
    """Chooses the cells to prefetch.

    Parameters
    ----------
    is_missing
        Whether a layer of a cell, by index, is to be listed: it is not in memory.
    outage_tolerance_s
        Duration of an outage of the origin that clients must not notice, seconds.

    Attributes
    ----------
    paths : dict
        Paths by client.
    health
        State of the origin.
    """

    def __init__(self, is_missing: Callable[[int, str], bool], outage_tolerance_s: float) -> None:
        self._is_missing = is_missing
        self._outage_tolerance_s = outage_tolerance_s
        self._catalogue: CatalogueView | None = None
        self.paths: dict[Hashable, ClientPath] = {}
        self.health = OriginHealth()
        self._out_since_s = math.inf
        self._away_s = 0.0
        self._listed: list[_Listed] = []
        self._making: Iterator[None] | None = None  # of the next list
        self._made_s = -math.inf
        self._interval_s = PASS_S
        self._is_due = False  # sooner than that

    def follow(self, client: Hashable, motion: Motion, area: Area, layers: tuple[str, ...]) -> None:
        """Prefetch for a client, given its motion and its last requested area and layers."""
        path = self.paths.get(client)
        if path is None or path.motion is not motion:
            path = self.paths[client] = ClientPath(motion, area, layers)
        path.area, path.layers = area, layers
        if path.jumps != motion.jumps:
            path.jumps, self._is_due = motion.jumps, True

    @property
    def look_ahead(self) -> LookAhead:
        """Current look-ahead; cells beyond it are not wished for yet."""
        load_s = SLOW_LOADS * self.health.slow_s + SLACK_S + self._interval_s - PASS_S
        route_s = load_s + SPARE * self._outage_tolerance_s + AFTER_S
        straight_s = load_s + min(self._outage_tolerance_s, self._away_s, GUESSED_S)
        return LookAhead(route_s, straight_s, load_s)

    def next(self, catalogue: CatalogueView, now_s: float, reader: Reader) -> Wish | None:
        """Return what a reader lacks and is needed first; if None, it asks again at `next_s`."""
        if self._is_back(now_s) or catalogue is not self._catalogue:
            # indices mean other cells now, or cells skipped for a failure may be tried
            self.restart()
            self._catalogue = catalogue
        if now_s < self.health.next_try_s():
            return None
        if self._making is None and now_s >= self._next_pass_s:
            self._is_due, self._making = False, self._make(catalogue, now_s)
        if self._making is not None:
            if next(self._making, self) is not self:
                return None
            self._making, self._made_s = None, now_s
        wish = self._read(reader, now_s)
        if wish is not None:
            self.health.tried(now_s)
        return wish

    def restart(self) -> None:
        """Look along all paths again: more of the map along them is known now."""
        self._catalogue, self._listed, self._making, self._made_s = None, [], None, -math.inf

    def _read(self, reader: Reader, now_s: float) -> Wish | None:
        """Return the first cell of the list that a reader lacks; it passes over a bounded number."""
        if reader.listed is not self._listed:
            reader.listed, reader.read = self._listed, 0
        for one in reader.listed[reader.read : reader.read + READ_PER_CALL]:
            path = self.paths.get(one.client)
            if path is not None and path.jumps == one.jumps and reader.lacks(one.cell, one.layer):
                return Wish(one.cell, one.layer, max(one.needed_s - now_s, 0.0))
            reader.read += 1
        return None

    def _make(self, catalogue: CatalogueView, now_s: float) -> Iterator[None]:
        """Look along all paths, a part at a time, and list what is missing on them."""
        ahead, step_m = self.look_ahead, max(SHORTEST_STEP_M, 0.5 * min(catalogue.mean_size))
        found: dict[tuple[int, str], _Listed] = {}
        until_s = math.inf
        total = work = 0
        for client, path in list(self.paths.items()):
            jumps, path.work = path.jumps, 0
            for needed_in_s, cells in path.look(catalogue, ahead, step_m):
                needed_s = now_s + needed_in_s
                if needed_s >= until_s:
                    break
                for key in product(cells, path.layers):
                    known = found.get(key)
                    if (known is None or needed_s < known.needed_s) and self._is_missing(*key):
                        found[key] = _Listed(needed_s, *key, client, jumps)
                if len(found) > 2 * MAX_LISTED:
                    first = sorted(found.values(), key=_needed_s)[:MAX_LISTED]
                    found, until_s = {one[1:3]: one for one in first}, first[-1].needed_s
                    self._is_due = True  # the others are listed next time
                work += path.work + CELL_WORK * len(cells) * len(path.layers)
                path.work = 0
                if work >= WORK_PER_CALL:
                    total, work = total + work, 0
                    yield
        self._listed = sorted(found.values(), key=_needed_s)
        self._interval_s = max(PASS_S, WORK_S * (total + work))

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

    def next_s(self, now_s: float, reader: Reader) -> float:
        """Return when a reader is to ask again if nothing happens until then."""
        if not any(path.moves for path in self.paths.values()):
            return math.inf
        is_read = reader.listed is self._listed and reader.read == len(self._listed)
        next_s = self._next_pass_s if is_read and self._making is None else now_s
        return max(next_s, self.health.next_try_s())

    @property
    def _next_pass_s(self) -> float:
        return self._made_s + (PASS_S if self._is_due else self._interval_s)


_needed_s = attrgetter("needed_s")

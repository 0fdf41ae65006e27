# SPDX-License-Identifier: Apache-2.0
"""Estimate of when a cell will be needed: by the client that reaches it first.

Each client contributes a few *places*: its present position, its future positions along its route, and the
route's end, from which it may go anywhere.  Cells within a place's reach are needed when the client arrives;
cells beyond it are needed later, the farther away, the later.  `until_needed` takes the minimum over all
places.

A client without a route may go anywhere, more likely ahead than back: its only place is its position, and the
time to a cell is multiplied by 1 for a cell straight ahead up to 2 for a cell behind.  A client with a route
needs the cells along it when it arrives there, and all others after the route's end, except those just beside
it now.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from shmmap.daemon.travel.motion import Motion

Places: TypeAlias = NDArray[np.float64]
"""(P, 8): x, y, arrival time of the client (s), its reach (m), how far beyond it the place is valid (m),
seconds per metre beyond the reach, and the unit vector of its heading, 0 if unknown."""

NOWHERE: Final = np.empty((0, 8))
MAX_PLACES: Final = 256
"""Limit of places, since each adds scoring time; beyond it, places near each other become one."""
MAX_MERGED: Final = 1024
"""Limit of places to merge, which takes a third of a millisecond; beyond it, some are left out."""
MAX_PER_CLIENT: Final = 128
"""Places along a route; on a long route, the later ones are farther apart."""
NEAREST_M: Final = 10.0
"""Minimum distance of places along a route; it is also at least an eighth of the client's reach."""
SLOWEST_MPS: Final = 3.0
"""Assumed speed of a client that stands still: it may drive off."""
STAY_M: Final = 10.0
"""Margin around a client's reach that counts as needed whatever its route: it may turn or leave it."""
PAIRS_PER_BLOCK: Final = 4096
"""Pairs of a cell and a place scored together: their tables fit in the processor's cache."""
WORK_S: Final = 8e-7
"""Interval for each unit of work, which is to compare one cell with one place or area.  It takes a fortieth
of that, so that listing what is evicted and what is fetched ahead takes a twentieth of a core at most."""
FIRST_SIDE_M: Final = 16.0
"""Side of the squares in which places are first merged, where there are too many."""
SQUARE_M: Final = 100.0
"""Side of the squares whose cells are judged together, see `widened`."""


def places_of(motion: Motion, reach_m: float) -> Places:
    """Return the places of one client.

    Parameters
    ----------
    reach_m
        Radius around the client within which it needs the map, metres.
    """
    speed = max(motion.speed_mps, SLOWEST_MPS)
    pace = 1.0 / speed
    here = [motion.x, motion.y, motion.at_s, reach_m]
    heading = [motion.vx / speed, motion.vy / speed] if motion.speed_mps >= SLOWEST_MPS else [0.0, 0.0]
    route = motion.route
    if route is None or route.length_m <= motion.along_m:
        return np.array([[*here, math.inf, pace, *heading]])
    speed = max(motion.fastest_mps, SLOWEST_MPS)
    left_m = route.length_m - motion.along_m
    near_m = max(reach_m / 8.0, NEAREST_M)
    count = min(MAX_PER_CLIENT - 2, max(1, math.ceil(left_m / near_m)))
    # the first places are ``near_m`` apart; if that needs too many, later ones are farther apart
    power = max(1.0, math.log(left_m / near_m) / math.log(count)) if count > 1 else 1.0
    ahead_m = left_m * (np.arange(1, count + 1) / count) ** power
    apart_m = np.diff(ahead_m, prepend=0.0)
    found = np.zeros((count + 2, 8))
    found[0] = [*here, STAY_M, pace, *heading]
    found[1:-1, :2] = route.at(motion.along_m + ahead_m)
    # a cell that comes into reach between two places is needed before the client is at the second
    found[1:-1, 2] = motion.at_s + (ahead_m - 0.5 * apart_m) / speed
    found[1:-1, 3] = reach_m
    found[1:-1, 4] = 0.5 * apart_m  # between two places the client is no farther from either
    found[-1] = [*found[-2, :2], motion.at_s + left_m / speed, reach_m, math.inf, pace, 0.0, 0.0]
    return found


def differ(before: Places, now: Places) -> bool:
    """Whether places differ by more than their times: the client moved, or will go elsewhere."""
    return len(before) != len(now) or bool(np.delete(before != now, 2, axis=1).any())


def merged_places(some: Iterable[Places]) -> Places:
    """Return the places of many clients as one table of at most `MAX_PLACES`.

    Where there are more, the earliest place in each square stands for all in it.
    """
    tables = list(some)
    if not tables:
        return NOWHERE
    thin = sum(map(len, tables)) // MAX_MERGED + 1
    if thin > 1:  # keep each table's first and last place and some in between
        tables = [part for table in tables for part in (table[:-1:thin], table[-1:])]
    found = np.concatenate(tables)
    if len(found) > MAX_PLACES:
        found = found[np.argsort(found[:, 2], kind="stable")]
    side = FIRST_SIDE_M
    while len(found) > MAX_PLACES:
        squares = np.floor(np.clip(found[:, :2] / side, -(2.0**30), 2.0**30)).astype(np.int64)
        keys = squares[:, 0] << 32 | squares[:, 1] & 0xFFFFFFFF
        keys = keys << 1 ^ np.isinf(found[:, 4])  # places from which anything may be reached stay separate
        _, first = np.unique(keys, return_index=True)
        found = found[np.sort(first)]
        side *= 2.0 if len(found) < 4 * MAX_PLACES else 4.0
    return found


def until_needed(boxes: NDArray[np.float64], places: Places, now_s: float) -> NDArray[np.float64]:
    """Return the time until each cell will be needed, seconds, (N,); 0 for now.

    Parameters
    ----------
    boxes
        (N, 4) ``min_x, min_y, max_x, max_y``, metres, map frame.
    places
        Places; without an open one, a cell may never be needed: infinity.
    """
    found = np.full(len(boxes), np.inf)
    heads = (places[:, 6] != 0.0) | (places[:, 7] != 0.0)
    for some, somewhere in ((places[heads], True), (places[~heads], False)):
        together = max(1, PAIRS_PER_BLOCK // max(1, len(some)))
        for begin in range(0, len(boxes) if len(some) else 0, together):
            part = slice(begin, begin + together)
            np.minimum(found[part], _until(boxes[part], some, now_s, somewhere=somewhere), out=found[part])
    return found


def widened(places: Places, now_s: float) -> Places:
    """Return places by which a square's middle is needed no sooner than any cell whose middle lies in it.

    A cell is at most half a diagonal farther away from a place than the middle of the square, and as it lies
    in another direction, each metre of that may count for one and a half more.
    """
    half_m = SQUARE_M / math.sqrt(2.0)
    found: Places = places.copy()
    found[:, 2] = np.maximum(places[:, 2], now_s) + 1.5 * half_m * places[:, 5]
    found[:, 3] -= half_m
    return found


def _until(
    boxes: NDArray[np.float64], places: Places, now_s: float, *, somewhere: bool
) -> NDArray[np.float64]:
    """Return the time until each cell will be needed; ``somewhere``: clients have a heading."""
    x, y, at_s, reach, limit, pace, hx, hy = places.T[:, :, np.newaxis]
    dx = np.maximum(np.maximum(boxes[:, 0] - x, x - boxes[:, 2]), 0.0)
    dy = np.maximum(np.maximum(boxes[:, 1] - y, y - boxes[:, 3]), 0.0)
    gap = np.maximum(np.sqrt(dx * dx + dy * dy) - reach, 0.0)
    slower: NDArray[np.float64] | float = 1.5
    if somewhere:
        cx, cy = 0.5 * (boxes[:, 0] + boxes[:, 2]) - x, 0.5 * (boxes[:, 1] + boxes[:, 3]) - y
        slower = 1.5 - 0.5 * (cx * hx + cy * hy) / np.maximum(np.sqrt(cx * cx + cy * cy), 1e-9)
    times = np.maximum(at_s - now_s, 0.0) + gap * (pace * slower)
    least: NDArray[np.float64] = np.where(gap <= limit, times, np.inf).min(axis=0)
    return least

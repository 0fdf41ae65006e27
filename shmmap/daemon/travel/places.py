# SPDX-License-Identifier: Apache-2.0
"""When a cell will be needed: by the client that comes to it first.

Each client gives a few *places*: where it is, where it will be along its route, and the route's end, after
which it may go anywhere.  From a place, cells within its reach are needed when the client is there; those
beyond it later, the farther away the later.  `until_needed` takes the least over all places.

A client without a route may go anywhere, rather ahead than back: its only place is where it is, and the time
to a cell is multiplied by 1 for one straight ahead, 2 for one behind it.  One with a route needs what lies
along it when it comes there; all else after the route's end, but for what is just beside it now.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from shmmap.daemon.travel.motion import Motion

__all__ = ["MAX_PLACES", "NOWHERE", "Places", "merged_places", "places_of", "until_needed"]

Places: TypeAlias = NDArray[np.float64]
"""(P, 8): x, y, when the client is there (s), its reach (m), how far beyond that the place says anything (m),
seconds per metre beyond its reach, and the unit vector of its heading, 0 if unknown."""

NOWHERE: Final = np.empty((0, 8))
MAX_PLACES: Final = 256
"""Scoring takes time for each: of more places, the first counts of those that are near each other."""
MAX_MERGED: Final = 1024
"""Merging takes time, too: a third of a millisecond.  Of more places, some are left out."""
MAX_PER_CLIENT: Final = 128
"""Places along a route; the longer it is, the farther apart are those that come late."""
NEAREST_M: Final = 10.0
"""Places along a route are at least this far apart, and an eighth of the client's reach."""
SLOWEST_MPS: Final = 3.0
"""A client that stands still may drive off."""
STAY_M: Final = 10.0
"""What is just beyond a client's reach stays, whatever its route says: it may turn round or leave it."""
PAIRS_PER_BLOCK: Final = 4096
"""Pairs of a cell and a place that are scored together: their tables stay in the processor's cache."""
FIRST_SIDE_M: Final = 16.0
"""Places in one square of this side count as one at first, where there are too many."""


def places_of(motion: Motion, reach_m: float) -> Places:
    """Return the places of one client.

    Parameters
    ----------
    reach_m
        How far around it it needs the map, metres.
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
    # the first ones ``near_m`` apart; if that needs too many, later ones farther
    power = max(1.0, math.log(left_m / near_m) / math.log(count)) if count > 1 else 1.0
    ahead_m = left_m * (np.arange(1, count + 1) / count) ** power
    apart_m = np.diff(ahead_m, prepend=0.0)
    found = np.zeros((count + 2, 8))
    found[0] = [*here, STAY_M, pace, *heading]
    found[1:-1, :2] = route.at(motion.along_m + ahead_m)
    # what comes into reach between two places is needed before the client is at the second
    found[1:-1, 2] = motion.at_s + (ahead_m - 0.5 * apart_m) / speed
    found[1:-1, 3] = reach_m
    found[1:-1, 4] = 0.5 * apart_m  # between two places the client is no farther from either
    found[-1] = [*found[-2, :2], motion.at_s + left_m / speed, reach_m, math.inf, pace, 0.0, 0.0]
    return found


def merged_places(some: Iterable[Places]) -> Places:
    """Return the places of many clients as one table of at most `MAX_PLACES`.

    Where there are more, the earliest of those in one square stands for all of them.
    """
    tables = list(some)
    if not tables:
        return NOWHERE
    thin = sum(map(len, tables)) // MAX_MERGED + 1
    if thin > 1:  # of each its first place, its last and some between them
        tables = [part for table in tables for part in (table[:-1:thin], table[-1:])]
    found = np.concatenate(tables)
    if len(found) > MAX_PLACES:
        found = found[np.argsort(found[:, 2], kind="stable")]
    side = FIRST_SIDE_M
    while len(found) > MAX_PLACES:
        squares = np.floor(np.clip(found[:, :2] / side, -(2.0**30), 2.0**30)).astype(np.int64)
        keys = squares[:, 0] << 32 | squares[:, 1] & 0xFFFFFFFF
        keys = keys << 1 ^ np.isinf(found[:, 4])  # from a place that is open anything may be reached
        _, first = np.unique(keys, return_index=True)
        found = found[np.sort(first)]
        side *= 2.0 if len(found) < 4 * MAX_PLACES else 4.0
    return found


def until_needed(boxes: NDArray[np.float64], places: Places, now_s: float) -> NDArray[np.float64]:
    """Return in how many seconds each cell will be needed, (N,), 0 for now.

    Parameters
    ----------
    boxes
        (N, 4) ``min_x, min_y, max_x, max_y``, metres, map frame.
    places
        At least one of them open, or a cell may never be needed: infinity.
    """
    found = np.full(len(boxes), np.inf)
    heads = (places[:, 6] != 0.0) | (places[:, 7] != 0.0)
    for some, somewhere in ((places[heads], True), (places[~heads], False)):
        together = max(1, PAIRS_PER_BLOCK // max(1, len(some)))
        for begin in range(0, len(boxes) if len(some) else 0, together):
            part = slice(begin, begin + together)
            np.minimum(found[part], _until(boxes[part], some, now_s, somewhere=somewhere), out=found[part])
    return found


def _until(
    boxes: NDArray[np.float64], places: Places, now_s: float, *, somewhere: bool
) -> NDArray[np.float64]:
    """Return in how many seconds each cell will be needed; ``somewhere``: clients have a heading."""
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

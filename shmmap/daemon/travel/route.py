# SPDX-License-Identifier: Apache-2.0
"""The way that a client says it will take, by the metres along it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["FARTHEST_M", "MOST_VERTICES", "Route"]

FARTHEST_M: Final = 1e8
"""Coordinates beyond this, in metres, count as this."""
MOST_VERTICES: Final = 512
"""Of a route with more, so many are kept, most of them where it bends."""
OFF_ROUTE_M: Final = 100.0
"""A client farther away than this from its route is not on it."""
SLACK_M: Final = 10.0
"""Of two stretches of a route that are both so near (to this), the client is on the one that comes first."""
BEHIND_M: Final = 20.0
"""So far back on its route, at most, a client is looked for that had come farther: it may be a street that
is taken both ways."""


class Route:
    """A polyline ahead of a client.

    Parameters
    ----------
    vertices
        (x, y) each, metres, map frame, finite; at least one.

    Attributes
    ----------
    length_m : float
        From its first vertex to its last.
    last_heading : float
        Where to it goes at its end, radians counter-clockwise from the map's x axis; 0 for a single vertex.
    """

    def __init__(self, vertices: Sequence[tuple[float, float]]) -> None:
        self._at = np.array(vertices, dtype=np.float64).reshape(-1, 2).clip(-FARTHEST_M, FARTHEST_M)
        self._along = _along(self._at)
        self.length_m = float(self._along[-1])
        if len(self._at) > MOST_VERTICES:
            self._at = self._at[_telling(self._at, self._along)]
            self._along = _along(self._at)
            self.length_m = float(self._along[-1])
        steps, lengths = np.diff(self._at, axis=0), np.diff(self._along)
        moved = np.flatnonzero(lengths)
        last = steps[moved[-1]] if len(moved) else np.zeros(2)
        self.last_heading = math.atan2(last[1], last[0])
        self._steps, self._lengths = steps, lengths

    def at(self, along_m: NDArray[np.float64] | float) -> NDArray[np.float64]:
        """Positions so far along the route, (..., 2), metres, map frame; its ends for what is beyond them."""
        x = np.interp(along_m, self._along, self._at[:, 0])
        y = np.interp(along_m, self._along, self._at[:, 1])
        return np.stack([x, y], axis=-1)

    def find(self, x: float, y: float, from_m: float | None = None) -> float | None:
        """How far along the route a client is; None if it is not on it.

        Parameters
        ----------
        from_m
            How far along it has come, if it was on this route: where a route passes a place twice, the
            client is where it comes to next.
        """
        here = np.array([x, y])
        if not len(self._steps):
            near_m = float(np.hypot(*(self._at[0] - here)))
            return 0.0 if near_m <= OFF_ROUTE_M else None
        squares = np.maximum(self._lengths, 1e-9) ** 2
        share = np.clip(((here - self._at[:-1]) * self._steps).sum(axis=1) / squares, 0.0, 1.0)
        apart = self._at[:-1] + share[:, np.newaxis] * self._steps - here
        away = np.hypot(apart[:, 0], apart[:, 1])
        along = self._along[:-1] + share * self._lengths
        if from_m is not None:
            ahead = along >= from_m - BEHIND_M
            if ahead.any() and away[ahead].min() <= OFF_ROUTE_M:
                away = np.where(ahead, away, np.inf)
        nearest = float(away.min())
        if nearest > OFF_ROUTE_M:
            return None
        return self._first_near(away, along, nearest)

    @staticmethod
    def _first_near(away: NDArray[np.float64], along: NDArray[np.float64], nearest: float) -> float:
        """The nearest place of the first stretch that is about as near as any."""
        first = int(np.argmax(away <= nearest + SLACK_M))
        last = first
        while last + 1 < len(away) and away[last + 1] <= nearest + SLACK_M:
            last += 1
        return float(along[first + int(np.argmin(away[first : last + 1]))])


def _along(at: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far along a polyline each of its vertices is, metres."""
    steps = np.diff(at, axis=0)
    return np.concatenate(([0.0], np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))))


def _telling(at: NDArray[np.float64], along: NDArray[np.float64]) -> NDArray[np.intp]:
    """Which vertices tell most of a polyline's course, at most `MOST_VERTICES`, its ends among them.

    Chords stay about equally near to a curve if their ends are as dense as the square root of its
    curvature; half of the vertices are spread so, the others evenly.
    """
    steps = np.diff(at, axis=0)
    heading = np.arctan2(steps[:, 1], steps[:, 0])
    turn = np.abs((np.diff(heading) + math.pi) % (2.0 * math.pi) - math.pi)
    bend = np.concatenate(([0.0], np.cumsum(np.sqrt(turn * 0.5 * (along[2:] - along[:-2]))), [0.0]))
    bend[-1] = bend[-2]
    rank = along / max(along[-1], 1e-9) + bend / max(bend[-1], 1e-9)
    wanted = np.linspace(0.0, rank[-1], MOST_VERTICES)
    kept = np.unique(np.clip(np.searchsorted(rank, wanted), 0, len(at) - 1))
    kept[-1] = len(at) - 1
    return kept

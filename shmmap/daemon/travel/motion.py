# SPDX-License-Identifier: Apache-2.0
"""Motion of one client: its pose, its velocity, and its position on the route that it sends."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap.protocol.messages import Intent

MAX_SPEED_MPS: Final = 70.0
"""Speed limit of clients: a pose farther away than it allows is a jump."""
LEARN_S: Final = 0.5
"""Minimum time between the two poses from which a velocity is estimated."""
SILENT_S: Final = 10.0
"""Longest silence that counts as travel: a pose farther away than this time allows is a jump."""
TURN_RAD: Final = 0.35
"""Change of heading that ends a straight."""
TURNS_MPS: Final = 1.0
FASTEST_S: Final = 60.0
"""Time for which a client's high speed is remembered, roughly: it will go on after a red light."""
FARTHEST_M: Final = 1e8
"""Limit of coordinates, metres; larger ones are clamped."""
MAX_VERTICES: Final = 512
"""Vertices kept of a longer route, most of them in its bends."""
OFF_ROUTE_M: Final = 100.0
"""Distance from its route beyond which a client is not on it."""
SLACK_M: Final = 10.0
"""Of two stretches of a route whose distances differ by less than this, the client is on the first."""
BEHIND_M: Final = 20.0
"""Longest distance back on its route that a client is searched for: a street may be driven both ways."""


class Route:
    """Polyline that a client will follow.

    Parameters
    ----------
    vertices
        (x, y) each, metres, map frame, finite; at least one.

    Attributes
    ----------
    length_m : float
        Length from its first vertex to its last, metres.
    last_heading : float
        Heading at its end, radians counter-clockwise from the map's x axis; 0 for a single vertex.
    """

    def __init__(self, vertices: Sequence[tuple[float, float]]) -> None:
        at = np.array(vertices, dtype=np.float64).reshape(-1, 2).clip(-FARTHEST_M, FARTHEST_M)
        if len(at) > MAX_VERTICES:
            at = at[_significant(at, _along(at))]
        self._at, self._along = at, _along(at)
        self.length_m = float(self._along[-1])
        steps, lengths = np.diff(self._at, axis=0), np.diff(self._along)
        moved = np.flatnonzero(lengths)
        last = steps[moved[-1]] if len(moved) else np.zeros(2)
        self.last_heading = math.atan2(last[1], last[0])
        self._steps, self._lengths = steps, lengths

    def at(self, along_m: NDArray[np.float64] | float) -> NDArray[np.float64]:
        """Return positions along the route, (..., 2), metres, map frame; clamped to its ends."""
        x = np.interp(along_m, self._along, self._at[:, 0])
        y = np.interp(along_m, self._along, self._at[:, 1])
        return np.stack([x, y], axis=-1)

    def find(self, x: float, y: float, from_m: float | None = None) -> float | None:
        """Return how far along the route a client is; None if it is not on it.

        Parameters
        ----------
        from_m
            The client's last distance along this route, if any: where a route passes a place twice, the
            client is at the pass that it reaches next.
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
        # the nearest point of the first stretch whose distance is about the minimum
        far = np.append(away > nearest + SLACK_M, True)
        first = int(far.argmin())
        end = first + int(far[first:].argmax())
        return float(along[first + int(away[first:end].argmin())])


@dataclass(eq=False, slots=True)
class Motion:
    """Position, velocity and route of a client.

    Attributes
    ----------
    x, y
        Position, metres, map frame.
    at_s
        Time of the position, seconds.
    vx, vy
        Velocity, metres per second, map frame: as sent, else estimated from poses; 0 if not known.
    fastest_mps
        Its greatest recent speed.
    route, along_m
        The route that it sends, if it is on it, and its distance along the route.
    travelled_m
        Distance travelled since its last jump.
    straight_m
        Distance travelled without a turn.
    jumps
        Number of jumps of its position.
    """

    x: float = 0.0
    y: float = 0.0
    at_s: float = -math.inf
    vx: float = 0.0
    vy: float = 0.0
    fastest_mps: float = 0.0
    route: Route | None = None
    along_m: float = 0.0
    travelled_m: float = 0.0
    straight_m: float = 0.0
    jumps: int = 0
    _straight_rad: float = 0.0
    _vertices_hash: int = 0
    _sent_route: Route | None = None
    _come_m: float = 0.0
    _learnt: tuple[float, float, float] = field(default=(0.0, 0.0, -math.inf))

    @property
    def speed_mps(self) -> float:
        """Return its speed now."""
        return math.hypot(self.vx, self.vy)

    def update(self, intent: Intent, now_s: float) -> None:
        """Update from the pose, velocity and route that the client sends."""
        self._move(intent.x, intent.y, intent.vx, intent.vy, now_s)
        self._follow(intent.route)

    def _move(self, x: float, y: float, vx: float, vy: float, now_s: float) -> None:
        x, y = _within(x), _within(y)
        step_m, took_s = math.hypot(x - self.x, y - self.y), now_s - self.at_s
        if took_s == math.inf or step_m > MAX_SPEED_MPS * min(max(took_s, 1.0), SILENT_S):
            self.jumps += 1
            self.vx = self.vy = self.fastest_mps = self.travelled_m = self.straight_m = 0.0
            self._learnt = (x, y, now_s)
            took_s = 0.0
        else:
            self.travelled_m += step_m
            self.straight_m += step_m
        self.x, self.y, self.at_s = x, y, now_s
        if vx or vy:
            over = max(1.0, math.hypot(vx, vy) / MAX_SPEED_MPS)
            self.vx, self.vy = vx / over, vy / over
        else:
            self._learn(now_s)
        self._turn()
        self.fastest_mps = max(self.speed_mps, self.fastest_mps * math.exp(-took_s / FASTEST_S))

    def _learn(self, now_s: float) -> None:
        """Estimate the velocity from an earlier position."""
        x, y, since_s = self._learnt
        took_s = now_s - since_s
        if took_s < LEARN_S:
            return
        self._learnt = (self.x, self.y, now_s)
        self.vx, self.vy = (self.x - x) / took_s, (self.y - y) / took_s

    def _turn(self) -> None:
        """Detect the end of a straight; poses of a client that hardly moves are ignored."""
        if self.speed_mps < TURNS_MPS:
            return
        heading_rad = math.atan2(self.vy, self.vx)
        if abs(math.remainder(heading_rad - self._straight_rad, math.tau)) > TURN_RAD:
            self._straight_rad, self.straight_m = heading_rad, 0.0

    def _follow(self, vertices: tuple[tuple[float, float], ...]) -> None:
        """Find the client on its route."""
        before: float | None = self._come_m if self.route is not None else None
        sent = hash(vertices)
        if sent != self._vertices_hash:
            self._vertices_hash, before = sent, None
            self._sent_route = Route(vertices) if vertices else None
        along_m = None if self._sent_route is None else self._sent_route.find(self.x, self.y, before)
        self.route = None if along_m is None else self._sent_route
        self.along_m = along_m or 0.0
        self._come_m = self.along_m if before is None else max(before, self.along_m)


def _within(metres: float) -> float:
    """Clamp a coordinate to the range in which numbers are exact enough."""
    return max(-FARTHEST_M, min(metres, FARTHEST_M))


def _along(at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance of each vertex along a polyline, metres."""
    steps = np.diff(at, axis=0)
    return np.concatenate(([0.0], np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))))


def _significant(at: NDArray[np.float64], along: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the vertices that best describe a polyline, at most `MAX_VERTICES`, its ends among them.

    Chords stay about equally close to a curve if vertices are as dense as the square root of its curvature:
    half of the vertices are placed so, the others evenly.
    """
    steps = np.diff(at, axis=0)
    heading = np.arctan2(steps[:, 1], steps[:, 0])
    turn = np.abs((np.diff(heading) + math.pi) % (2.0 * math.pi) - math.pi)
    bend = np.concatenate(([0.0], np.cumsum(np.sqrt(turn * 0.5 * (along[2:] - along[:-2]))), [0.0]))
    bend[-1] = bend[-2]
    rank = along / max(along[-1], 1e-9) + bend / max(bend[-1], 1e-9)
    wanted = np.linspace(0.0, rank[-1], MAX_VERTICES)
    kept = np.unique(np.clip(np.searchsorted(rank, wanted), 0, len(at) - 1))
    kept[-1] = len(at) - 1
    return kept

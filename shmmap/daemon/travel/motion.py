# SPDX-License-Identifier: Apache-2.0
"""How one client moves: what it says of that, and what its poses tell."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

from shmmap.daemon.travel.route import FARTHEST_M, Route
from shmmap.protocol.messages import Intent

__all__ = ["MOST_SPEED_MPS", "Motion"]

MOST_SPEED_MPS: Final = 70.0
"""A pose that is farther away than this speed allows is a jump; nobody is taken to be faster."""
LEARN_S: Final = 0.5
"""Time between two poses, at least, from which a velocity is learnt."""
SILENT_S: Final = 10.0
"""Who says nothing for longer may have stood: who is farther away than one comes in this time has jumped."""
TURN_RAD: Final = 0.35
"""Who has turned by more since then has left the straight."""
TURNS_MPS: Final = 1.0
FASTEST_S: Final = 60.0
"""For about so long it is remembered how fast a client was: it will go on after a red light."""


@dataclass(eq=False, slots=True)
class Motion:
    """Where a client is, how it moves and where to.

    Attributes
    ----------
    x, y
        Metres, map frame.
    told_s
        When it was there.
    vx, vy
        Metres per second, map frame: as told, else learnt from the poses; 0 if not known.
    fastest_mps
        Its greatest speed of late.
    route, along_m
        The way it says it will take, if it is on it, and how far along it is.
    travelled_m
        How far it has come since its last jump.
    straight_m
        How far it has come without a turn.
    jumps
        How often it was somewhere else all of a sudden.
    """

    x: float = 0.0
    y: float = 0.0
    told_s: float = -math.inf
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
    _told_route: Route | None = None
    _come_m: float = 0.0
    _learnt: tuple[float, float, float] = field(default=(0.0, 0.0, -math.inf))

    @property
    def speed_mps(self) -> float:
        """Its speed now."""
        return math.hypot(self.vx, self.vy)

    def told(self, intent: Intent, now_s: float) -> None:
        """A client says where it is, and perhaps where to it moves."""
        self._move(intent.x, intent.y, intent.vx, intent.vy, now_s)
        self._follow(intent.route)

    def _move(self, x: float, y: float, vx: float, vy: float, now_s: float) -> None:
        x, y = _within(x), _within(y)
        step_m, took_s = math.hypot(x - self.x, y - self.y), now_s - self.told_s
        if took_s == math.inf or step_m > MOST_SPEED_MPS * min(max(took_s, 1.0), SILENT_S):
            self.jumps += 1
            self.vx = self.vy = self.fastest_mps = self.travelled_m = self.straight_m = 0.0
            self._learnt = (x, y, now_s)
            took_s = 0.0
        else:
            self.travelled_m += step_m
            self.straight_m += step_m
        self.x, self.y, self.told_s = x, y, now_s
        if vx or vy:
            over = max(1.0, math.hypot(vx, vy) / MOST_SPEED_MPS)
            self.vx, self.vy = vx / over, vy / over
        else:
            self._learn(now_s)
        self._turn()
        self.fastest_mps = max(self.speed_mps, self.fastest_mps * math.exp(-took_s / FASTEST_S))

    def _learn(self, now_s: float) -> None:
        """Take the velocity from where the client was a while ago."""
        x, y, since_s = self._learnt
        took_s = now_s - since_s
        if took_s < LEARN_S:
            return
        self._learnt = (self.x, self.y, now_s)
        self.vx, self.vy = (self.x - x) / took_s, (self.y - y) / took_s

    def _turn(self) -> None:
        """See whether it is still straight on; poses of who hardly moves tell nothing of that."""
        if self.speed_mps < TURNS_MPS:
            return
        heading_rad = math.atan2(self.vy, self.vx)
        if abs(math.remainder(heading_rad - self._straight_rad, math.tau)) > TURN_RAD:
            self._straight_rad, self.straight_m = heading_rad, 0.0

    def _follow(self, vertices: tuple[tuple[float, float], ...]) -> None:
        """Find the client on the way that it says it will take."""
        before: float | None = self._come_m if self.route is not None else None
        told = hash(vertices)
        if told != self._vertices_hash:
            self._vertices_hash, before = told, None
            self._told_route = Route(vertices) if vertices else None
        along_m = None if self._told_route is None else self._told_route.find(self.x, self.y, before)
        self.route = None if along_m is None else self._told_route
        self.along_m = along_m or 0.0
        self._come_m = self.along_m if before is None else max(before, self.along_m)


def _within(metres: float) -> float:
    """Anything farther away than numbers stay exact counts at the edge of that."""
    return max(-FARTHEST_M, min(metres, FARTHEST_M))

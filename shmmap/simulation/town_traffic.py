# SPDX-License-Identifier: Apache-2.0
"""Cars and people that move through a generated town, as points."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap.simulation.town import Town

__all__ = ["Traffic"]

_CAR: Final = (4.4, 1.8, 1.5)  # length, width, height, metres
_PERSON: Final = (0.5, 0.5, 1.75)
_ONCOMING_METRES: Final = 3.2  # from the drive's lane to the other one
_PAVEMENT_METRES: Final = 4.5  # from the drive's lane to where people walk
_CAR_GAP: Final = 18.0
_PERSON_GAP: Final = 11.0
_CAR_SPEED: Final = 8.0
_PERSON_SPEED: Final = 1.3


class Traffic:
    """Cars that come towards a drive on its other lane, and people on the pavement beside it.

    Parameters
    ----------
    town
        Where.
    route
        (N, 3) as `Town.route` gives it.
    seed
        Which traffic.
    density
        Points per square metre of surface.
    """

    def __init__(
        self, town: Town, route: NDArray[np.float64], *, seed: int = 0, density: float = 600.0
    ) -> None:
        self._town = town
        self._route = route
        steps = np.hypot(*np.diff(route[:, :2], axis=0).T)
        self._along = np.concatenate([[0.0], np.cumsum(steps)])
        rng = np.random.Generator(np.random.PCG64([seed, 7]))
        length = float(self._along[-1])
        self._cars = _spread(rng, 2 * length, _CAR_GAP)
        self._people = _spread(rng, length, _PERSON_GAP)
        self._car = _box(rng, _CAR, density)
        self._person = _box(rng, _PERSON, density)

    def points(self, time_s: float) -> NDArray[np.float64]:
        """Points of everything that moves, at a time, (N, 3) float64, map frame, metres."""
        parts = [
            self._placed(self._car, at - _CAR_SPEED * time_s, -_ONCOMING_METRES, 0.25) for at in self._cars
        ]
        parts += [
            self._placed(self._person, at + _PERSON_SPEED * time_s, _PAVEMENT_METRES, 0.0)
            for at in self._people
        ]
        every = [part for part in parts if part is not None]
        return np.concatenate(every) if every else np.empty((0, 3))

    def _placed(
        self, shape: NDArray[np.float64], at: float, right: float, above: float
    ) -> NDArray[np.float64] | None:
        if not 0.0 <= at <= self._along[-1]:
            return None
        x, y, heading = (float(np.interp(at, self._along, self._route[:, n])) for n in range(3))
        cos, sin = math.cos(heading), math.sin(heading)
        x, y = x + right * sin, y - right * cos
        z = float(self._town.ground_height(np.array(x), np.array(y))) + above
        turned = np.column_stack(
            [cos * shape[:, 0] - sin * shape[:, 1], sin * shape[:, 0] + cos * shape[:, 1], shape[:, 2]]
        )
        turned += np.array([x, y, z])
        return turned


def _spread(rng: np.random.Generator, length: float, gap: float) -> NDArray[np.float64]:
    """Places along a length, about a gap apart, metres."""
    places = np.arange(0.0, length, gap)
    return places + rng.uniform(-0.25 * gap, 0.25 * gap, len(places))


def _box(rng: np.random.Generator, size: tuple[float, float, float], density: float) -> NDArray[np.float64]:
    """Points on the sides and the top of a box that stands on the ground, its middle at the origin."""
    length, width, height = size
    sides = ((length, 0, -width / 2), (length, 0, width / 2), (width, 1, -length / 2), (width, 1, length / 2))
    parts = []
    for side, along, offset in sides:
        count = max(1, round(side * height * density))
        face = np.full((count, 3), offset)
        face[:, along] = rng.uniform(-side / 2, side / 2, count)
        face[:, 2] = rng.uniform(0, height, count)
        parts.append(face)
    count = max(1, round(length * width * density))
    middle = np.array([length, width]) / 2
    top = np.column_stack([rng.uniform(-middle, middle, (count, 2)), np.full(count, height)])
    return np.concatenate([*parts, top])

# SPDX-License-Identifier: Apache-2.0
"""The ground of the generated town, the surfaces of objects on it, and points sampled on them.

The ground consists of smooth hills, with streets a curb's height below the blocks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

BLOCK_METRES = 80.0
"""Distance between street centre lines, in x and in y."""
ROAD_HALF_METRES = 4.0
"""Distance from a street's centre line to its curb."""
CURB_METRES = 0.12

# Four waves: (wavelength, height) in metres; together slopes stay below 10 %.
_WAVES = ((913.0, 6.0), (541.0, 3.0), (277.0, 1.0), (131.0, 0.25))


class Ground:
    """Height of the ground as a function of town coordinates (metres from the town's corner)."""

    def __init__(self, seed: int) -> None:
        rng = np.random.Generator(np.random.PCG64([seed, 1]))
        angles, self._phases = rng.uniform(0.0, 2.0 * np.pi, (2, len(_WAVES)))
        lengths = np.array([length for length, _ in _WAVES])
        self._heights = np.array([height for _, height in _WAVES])
        self._kx = 2.0 * np.pi * np.cos(angles) / lengths
        self._ky = 2.0 * np.pi * np.sin(angles) / lengths

    def terrain(self, x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.float64]:
        """Return the height of the hills alone, metres."""
        z = np.zeros(np.broadcast(x, y).shape)
        for kx, ky, phase, height in zip(self._kx, self._ky, self._phases, self._heights, strict=True):
            z += height * np.sin(kx * x + (ky * y + phase))
        return z

    def height(self, x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.float64]:
        """Return the height of the ground, metres: the hills, plus the curb away from the streets."""
        return self.terrain(x, y) + CURB_METRES * (street_distance(x, y) >= ROAD_HALF_METRES)


def street_distance(x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.float64]:
    """Return the distance to the nearest street centre line, metres."""
    across_x = np.abs(x - BLOCK_METRES * np.rint(x / BLOCK_METRES))
    across_y = np.abs(y - BLOCK_METRES * np.rint(y / BLOCK_METRES))
    return np.minimum(across_x, across_y)


Points = NDArray[np.float32]
Vector = tuple[float, float, float]

_RANGE_NOISE_METRES = 0.015
_WINDOW_RECESS_METRES = 0.12
_ROOF_SHARE = 0.6  # of the density of points on other surfaces
_WINDOW_INTENSITY = 12.0
# glass reflects most of the laser away
_WINDOW_RETURNS = 0.25
_FOLIAGE_PER_METRE2 = 1.5

_PLAIN, _WINDOWS, _TRIANGLE = 0.0, 1.0, 2.0


@dataclass(slots=True)
class Surfaces:
    """Parallelograms, triangles, upright cylinders and tree crowns; metres, tile coordinates."""

    _flat: list[tuple[float, ...]] = field(default_factory=list)
    _cylinders: list[tuple[float, ...]] = field(default_factory=list)
    _crowns: list[tuple[float, ...]] = field(default_factory=list)
    footprints: list[tuple[float, float, float, float, float]] = field(default_factory=list)
    """Rectangles that hide the ground: centre x and y, half length, half width, yaw (radians)."""

    def flat(
        self,
        corner: Vector,
        u: Vector,
        v: Vector,
        intensity: float,
        *,
        windows: bool = False,
        triangle: bool = False,
        share: float = 1.0,
    ) -> None:
        """Add the parallelogram (or half of it) ``corner + a u + b v``, facing ``u x v``.

        ``share`` scales the density of its points.
        """
        kind = _WINDOWS if windows else _TRIANGLE if triangle else _PLAIN
        self._flat.append((*corner, *u, *v, intensity, share, kind))

    def cylinder(self, x: float, y: float, z: float, radius: float, height: float, intensity: float) -> None:
        """Add an upright cylinder standing at ``z``."""
        self._cylinders.append((x, y, z, radius, height, intensity))

    def crown(self, x: float, y: float, z: float, radius: float, height: float, intensity: float) -> None:
        """Add a tree crown, an ellipsoid of leaves around its centre at ``z``."""
        self._crowns.append((x, y, z, radius, height / 2, intensity))

    def box(
        self,
        center: tuple[float, float],
        half: tuple[float, float],
        yaw: float,
        z: float,
        height: float,
        intensity: float,
        *,
        windows: bool = False,
        ridge: float = 0.0,
        roof_intensity: float = 40.0,
    ) -> None:
        """Add an upright box; with ``ridge`` > 0 a gable roof of that height, else a flat roof."""
        self.footprints.append((*center, *half, yaw))
        cos, sin = math.cos(yaw), math.sin(yaw)
        along, across = (cos * half[0], sin * half[0]), (-sin * half[1], cos * half[1])

        def at(a: float, b: float, up: float) -> Vector:
            return (
                center[0] + a * along[0] + b * across[0],
                center[1] + a * along[1] + b * across[1],
                z + up,
            )

        long: Vector = (2 * along[0], 2 * along[1], 0.0)
        wide: Vector = (2 * across[0], 2 * across[1], 0.0)
        back_long, back_wide = _minus(long), _minus(wide)
        upward: Vector = (0.0, 0.0, height)
        for corner, edge in (
            (at(-1, -1, 0), long),
            (at(1, -1, 0), wide),
            (at(1, 1, 0), back_long),
            (at(-1, 1, 0), back_wide),
        ):
            self.flat(corner, edge, upward, intensity, windows=windows)
        if ridge <= 0.0:
            self.flat(at(-1, -1, height), long, wide, roof_intensity, share=_ROOF_SHARE)
            return
        slope = (across[0], across[1], ridge)
        other_slope = (-across[0], -across[1], ridge)
        self.flat(at(-1, -1, height), long, slope, roof_intensity, share=_ROOF_SHARE)
        self.flat(at(1, 1, height), back_long, other_slope, roof_intensity, share=_ROOF_SHARE)
        for end, edge in ((1.0, wide), (-1.0, back_wide)):
            # two right-angled halves that meet below the ridge
            half_edge: Vector = (edge[0] / 2, edge[1] / 2, 0.0)
            middle = at(end, 0, height)
            self.flat(middle, half_edge, (0.0, 0.0, ridge), intensity, triangle=True)
            self.flat(middle, _minus(half_edge), (0.0, 0.0, ridge), intensity, triangle=True)

    def sample(self, rng: np.random.Generator, density: float) -> tuple[Points, Points]:
        """Return points on all surfaces: (N, 3) float32 in tile coordinates, and (N,) float32 intensity.

        ``density`` is in points per square metre.
        """
        parts = [
            self._sample_flat(rng, density),
            self._sample_cylinders(rng, density),
            self._sample_crowns(rng, density),
        ]
        return np.concatenate([xyz for xyz, _ in parts]), np.concatenate([i for _, i in parts])

    def _sample_flat(self, rng: np.random.Generator, density: float) -> tuple[Points, Points]:
        table = np.array(self._flat, dtype=np.float32).reshape(-1, 12)
        corner, u, v = table[:, 0:3], table[:, 3:6], table[:, 6:9]
        normal = np.cross(u, v)
        area = np.linalg.norm(normal, axis=1)
        which = np.repeat(np.arange(len(table)), np.rint(area * table[:, 10] * density).astype(np.int64))
        a, b = rng.random((2, len(which)), dtype=np.float32)
        kind = table[which, 11]
        # a triangle is the half of its parallelogram on the corner's side
        outside = (kind == _TRIANGLE) & (a + b > 1)
        a[outside], b[outside] = 1 - a[outside], 1 - b[outside]
        length = np.linalg.norm(u, axis=1)[which]
        height = np.linalg.norm(v, axis=1)[which]
        glass = (
            (kind == _WINDOWS)
            & (np.abs((a * length) % np.float32(2.8) - np.float32(1.5)) < 0.6)
            & (np.abs((b * height) % np.float32(3.0) - np.float32(1.7)) < 0.65)
        )
        depth = rng.standard_normal(len(which), dtype=np.float32) * np.float32(_RANGE_NOISE_METRES)
        depth -= np.float32(_WINDOW_RECESS_METRES) * glass
        intensity = table[which, 9] + rng.standard_normal(len(which), dtype=np.float32) * np.float32(4.0)
        intensity[glass] = _WINDOW_INTENSITY
        unit = normal / np.maximum(area, np.float32(1e-6))[:, None]
        xyz = corner[which]
        xyz += a[:, None] * u[which]
        xyz += b[:, None] * v[which]
        xyz += depth[:, None] * unit[which]
        seen = ~glass | (rng.random(len(which), dtype=np.float32) < _WINDOW_RETURNS)
        return xyz[seen], intensity[seen]

    def _sample_cylinders(self, rng: np.random.Generator, density: float) -> tuple[Points, Points]:
        table = np.array(self._cylinders, dtype=np.float32).reshape(-1, 6)
        # thin objects are hit from all sides: at least 20 points per metre of height
        per_metre = np.maximum(2 * np.pi * table[:, 3] * density, 20.0)
        rows = table[np.repeat(np.arange(len(table)), np.rint(per_metre * table[:, 4]).astype(np.int64))]
        angle = rng.random(len(rows), dtype=np.float32) * np.float32(2 * np.pi)
        radius = rows[:, 3] + rng.standard_normal(len(rows), dtype=np.float32) * np.float32(0.01)
        up = rows[:, 4] * rng.random(len(rows), dtype=np.float32)
        xyz = rows[:, 0:3] + np.column_stack((radius * np.cos(angle), radius * np.sin(angle), up))
        return xyz, rows[:, 5] + rng.standard_normal(len(rows), dtype=np.float32) * np.float32(4.0)

    def _sample_crowns(self, rng: np.random.Generator, density: float) -> tuple[Points, Points]:
        table = np.array(self._crowns, dtype=np.float32).reshape(-1, 6)
        area = 4 * np.pi * table[:, 3] * np.sqrt(table[:, 3] * table[:, 4])
        counts = np.rint(area * density * _FOLIAGE_PER_METRE2 / 2).astype(np.int64)
        rows = table[np.repeat(np.arange(len(table)), counts)]
        direction = rng.standard_normal((len(rows), 3), dtype=np.float32)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True) + np.float32(1e-6)
        # leaves sit in the outer third, in clumps rather than on a smooth skin
        ripple = np.float32(0.12) * np.sin(np.float32(5.0) * direction).sum(axis=1)
        reach = np.float32(1.0) - np.float32(0.35) * rng.random(len(rows), dtype=np.float32) ** 2 + ripple
        xyz = rows[:, 0:3] + direction * reach[:, None] * rows[:, [3, 3, 4]]
        return xyz, rows[:, 5] + rng.standard_normal(len(rows), dtype=np.float32) * np.float32(10.0)


def _minus(vector: Vector) -> Vector:
    return -vector[0], -vector[1], -vector[2]

# SPDX-License-Identifier: Apache-2.0
"""The blocks of the generated town: houses, flats, a park, a hall or a church square."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from shmmap.simulation.town_surfaces import BLOCK_METRES, ROAD_HALF_METRES, Surfaces

Rng = np.random.Generator
Height = Callable[[float, float], float]
"""Height of the ground at tile coordinates."""

_SIDEWALK_METRES = 2.5
_LOW = ROAD_HALF_METRES + _SIDEWALK_METRES
_HIGH = BLOCK_METRES - _LOW
_MIDDLE = BLOCK_METRES / 2

_FOLIAGE, _BARK, _METAL, _STONE = 58.0, 35.0, 95.0, 70.0


def build_block(rng: Rng, ground: Height) -> Surfaces:
    """Return everything above the ground on one block, including its streets; tile coordinates."""
    surfaces = Surfaces()
    use = _USES[int(rng.choice(len(_USES), p=_SHARES))]
    use(rng, ground, surfaces)
    _line_streets(rng, ground, surfaces)
    return surfaces


def _tree(rng: Rng, ground: Height, surfaces: Surfaces, x: float, y: float, reach: float = 3.5) -> None:
    radius = float(rng.uniform(0.45, 1.0)) * reach
    trunk = float(rng.uniform(1.8, 3.2))
    height = radius * float(rng.uniform(1.6, 2.8))
    z = ground(x, y)
    surfaces.cylinder(x, y, z, float(rng.uniform(0.12, 0.3)), trunk + height * 0.3, _BARK)
    surfaces.crown(x, y, z + trunk + height / 2, radius, height, _FOLIAGE)


def _building(
    rng: Rng,
    ground: Height,
    surfaces: Surfaces,
    center: tuple[float, float],
    half: tuple[float, float],
    height: float,
    *,
    yaw: float = 0.0,
    ridge: float = 0.0,
    windows: bool = True,
) -> None:
    """Add a building whose walls reach below the lowest ground around it; buried parts are invisible."""
    reach = max(half)
    around = [ground(center[0] + a * reach, center[1] + b * reach) for a in (-1, 1) for b in (-1, 1)]
    depth = max(around) - min(around) + 0.5
    surfaces.box(
        center,
        half,
        yaw,
        max(around) - depth,
        height + depth,
        float(rng.uniform(50.0, 115.0)),
        windows=windows,
        ridge=ridge,
        roof_intensity=float(rng.uniform(25.0, 55.0)),
    )


def _wall(
    rng: Rng, ground: Height, surfaces: Surfaces, start: tuple[float, float], stop: tuple[float, float]
) -> None:
    """Add a garden wall or hedge along the ground, in steps of a few metres."""
    height, intensity = float(rng.uniform(0.8, 2.0)), float(rng.choice([_STONE, _FOLIAGE]))
    length = math.dist(start, stop)
    yaw = math.atan2(stop[1] - start[1], stop[0] - start[0])
    pieces = max(1, round(length / 6.0))
    for piece in range(pieces):
        along = (piece + 0.5) / pieces
        center = (start[0] + along * (stop[0] - start[0]), start[1] + along * (stop[1] - start[1]))
        half = (length / pieces / 2, 0.12)
        surfaces.box(
            center, half, yaw, ground(*center) - 0.2, height + 0.2, intensity, roof_intensity=intensity
        )


def _build_houses(rng: Rng, ground: Height, surfaces: Surfaces) -> None:
    """Build two rows of houses back to back, with gardens and walls between them."""
    for side in (0, 1):
        x = _LOW + float(rng.uniform(0.0, 2.0))
        while True:
            width = float(rng.uniform(9.0, 15.0))
            gap = float(rng.uniform(2.0, 5.0))
            if x + width > _HIGH:
                break
            depth = float(rng.uniform(9.0, 13.0))
            front = float(rng.uniform(1.0, 6.0))
            y = _LOW + front + depth / 2
            center = (x + width / 2, y if side == 0 else BLOCK_METRES - y)
            half = (width / 2 - 0.4, depth / 2)
            _building(
                rng,
                ground,
                surfaces,
                center,
                half,
                3.0 * int(rng.integers(1, 4)) + 0.6,
                yaw=float(rng.normal(0.0, 0.03)),
                ridge=float(rng.uniform(1.5, 4.0)),
            )
            edge = x + width + gap / 2
            if edge < _HIGH and rng.random() < 0.7:
                fence = (_LOW + front, _MIDDLE - 1.5)
                ends = fence if side == 0 else tuple(BLOCK_METRES - end for end in fence)
                _wall(rng, ground, surfaces, (edge, ends[0]), (edge, ends[1]))
            if rng.random() < 0.7:
                _tree(
                    rng, ground, surfaces, center[0], _MIDDLE + (side - 0.5) * float(rng.uniform(9.0, 13.0))
                )
            x += width + gap
    _wall(rng, ground, surfaces, (_LOW, _MIDDLE), (_HIGH, _MIDDLE))


def _build_flats(rng: Rng, ground: Height, surfaces: Surfaces) -> None:
    """Build long blocks of flats around a courtyard with trees."""
    deep = 5.5
    span = (_HIGH - _LOW) / 2
    for x, y, half in (
        (_MIDDLE, _LOW + deep + 1.0, (span - 2.0, deep)),
        (_MIDDLE, _HIGH - deep - 1.0, (span - 2.0, deep)),
        (_LOW + deep + 1.0, _MIDDLE, (deep, span - 2 * deep - 5.0)),
        (_HIGH - deep - 1.0, _MIDDLE, (deep, span - 2 * deep - 5.0)),
    ):
        if rng.random() < 0.85:
            storeys = int(rng.integers(3, 8))
            _building(rng, ground, surfaces, (x, y), half, 3.0 * storeys + 0.8)
    for _ in range(int(rng.integers(3, 8))):
        x, y = rng.uniform(_LOW + 18.0, _HIGH - 18.0, 2)
        _tree(rng, ground, surfaces, float(x), float(y))


def _build_park(rng: Rng, ground: Height, surfaces: Surfaces) -> None:
    """Plant trees, and build a wall with openings around them."""
    for x, y in rng.uniform(_LOW + 4.0, _HIGH - 4.0, (int(rng.integers(25, 45)), 2)):
        _tree(rng, ground, surfaces, float(x), float(y), reach=4.5)
    for fixed in (_LOW + 0.5, _HIGH - 0.5):
        for low, high in ((_LOW + 0.5, _MIDDLE - 3.0), (_MIDDLE + 3.0, _HIGH - 0.5)):
            _wall(rng, ground, surfaces, (low, fixed), (high, fixed))
            _wall(rng, ground, surfaces, (fixed, low), (fixed, high))


def _build_hall(rng: Rng, ground: Height, surfaces: Surfaces) -> None:
    """Build a large hall and a yard with containers."""
    half = (float(rng.uniform(18.0, 28.0)), float(rng.uniform(12.0, 18.0)))
    center = (_MIDDLE, _HIGH - half[1] - 2.0)
    _building(rng, ground, surfaces, center, half, float(rng.uniform(7.0, 11.0)), windows=False, ridge=1.5)
    for _ in range(int(rng.integers(3, 8))):
        x, y = float(rng.uniform(_LOW + 5.0, _HIGH - 5.0)), float(rng.uniform(_LOW + 4.0, _LOW + 18.0))
        yaw = float(rng.choice([0.0, math.pi / 2])) + float(rng.normal(0.0, 0.05))
        surfaces.box((x, y), (3.05, 1.22), yaw, ground(x, y), 2.6, float(rng.uniform(40.0, 110.0)))


def _build_square(rng: Rng, ground: Height, surfaces: Surfaces) -> None:
    """Build a church with a tower on an open square, with rows of trees along two sides."""
    yaw = float(rng.uniform(-0.5, 0.5))
    _building(rng, ground, surfaces, (_MIDDLE, _MIDDLE), (14.0, 6.0), 11.0, yaw=yaw, ridge=6.0)
    tower = (_MIDDLE - 17.0 * math.cos(yaw), _MIDDLE - 17.0 * math.sin(yaw))
    _building(rng, ground, surfaces, tower, (3.2, 3.2), 28.0, yaw=yaw, ridge=5.0)
    for x in np.arange(_LOW + 4.0, _HIGH - 3.0, 9.0):
        for y in (_LOW + 4.0, _HIGH - 4.0):
            _tree(rng, ground, surfaces, float(x), y, reach=3.0)


def _line_streets(rng: Rng, ground: Height, surfaces: Surfaces) -> None:
    """Add lamps, street trees and parked cars along the four streets."""
    curb = ROAD_HALF_METRES + 0.6
    planted = rng.random(4) < 0.4
    for street, has_trees in enumerate(planted.tolist()):
        across = curb if street < 2 else BLOCK_METRES - curb
        parked = ROAD_HALF_METRES - 1.0 if street < 2 else BLOCK_METRES - ROAD_HALF_METRES + 1.0
        upright = street % 2 == 1

        def place(along: float, off: float, upright: bool = upright) -> tuple[float, float]:
            return (off, along) if upright else (along, off)

        for along in np.arange(float(rng.uniform(9.0, 14.0)), _HIGH, 24.0):
            x, y = place(float(along), across)
            surfaces.cylinder(x, y, ground(x, y), 0.08, float(rng.uniform(6.0, 8.0)), _METAL)
            if has_trees:
                _tree(rng, ground, surfaces, *place(float(along) + 12.0, across + 0.4), reach=2.2)
        for along in np.arange(14.0, BLOCK_METRES - 14.0, 6.5):
            if rng.random() < 0.18:
                x, y = place(float(along), parked)
                yaw = (math.pi / 2 if upright else 0.0) + float(rng.normal(0.0, 0.02))
                paint = float(rng.uniform(30.0, 120.0))
                z = ground(x, y)
                surfaces.box((x, y), (2.2, 0.9), yaw, z + 0.15, 0.65, paint, roof_intensity=paint)
                surfaces.box((x, y), (1.2, 0.8), yaw, z + 0.8, 0.6, 15.0, roof_intensity=paint)


_USES = (_build_houses, _build_flats, _build_park, _build_hall, _build_square)
_SHARES = (0.5, 0.24, 0.1, 0.08, 0.08)

# SPDX-License-Identifier: Apache-2.0
"""A drive through the generated town's street grid, on the right, round the corners in arcs."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from shmmap.simulation.town_ground import BLOCK_METRES

__all__ = ["drive"]

_LANE_METRES = 1.5  # right of the centre line
_TURN_METRES = 6.0  # radius of a corner, on the centre line
_HEADINGS = ((1, 0), (0, 1), (-1, 0), (0, -1))


def drive(seed: int, blocks: tuple[int, int], length: float, step: float) -> NDArray[np.float64]:
    """Poses every ``step`` metres for at least ``length`` metres, town coordinates.

    Returns (N, 3) float64: x, y in metres, heading in radians counter-clockwise from +x, continuous
    (not wrapped).
    """
    crossings = _walk(seed, blocks, max(2, math.ceil(length / BLOCK_METRES) + 2))
    poses = _follow(crossings)
    gaps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    travelled = np.concatenate(([0.0], np.cumsum(gaps)))
    at = np.arange(0.0, min(length, float(travelled[-1])) + step / 2, step)
    return np.column_stack([np.interp(at, travelled, poses[:, i]) for i in range(3)])


def _walk(seed: int, blocks: tuple[int, int], steps: int) -> list[tuple[int, int]]:
    """Crossings visited: no turning round, streets not driven yet first."""
    rng = np.random.Generator(np.random.PCG64([seed, 2]))
    # the outermost streets lie half outside the town
    inner = min(blocks) >= 3
    low = 1 if inner else 0
    high = (blocks[0] - 1, blocks[1] - 1) if inner else blocks
    here = ((low + high[0]) // 2, (low + high[1]) // 2)
    visits: dict[frozenset[tuple[int, int]], int] = {}
    path, heading = [here], int(rng.integers(4))
    while len(path) <= steps:
        options = []
        for turn in (0, 1, 3, 2):
            dx, dy = _HEADINGS[(heading + turn) % 4]
            there = (here[0] + dx, here[1] + dy)
            if low <= there[0] <= high[0] and low <= there[1] <= high[1]:
                # turning round only where nothing else is left
                cost = visits.get(frozenset((here, there)), 0) + (1e6 if turn == 2 and len(path) > 1 else 0)
                options.append((cost + float(rng.random()) * 0.5, turn, there))
        _, turn, there = min(options)
        visits[frozenset((here, there))] = visits.get(frozenset((here, there)), 0) + 1
        heading, here = (heading + turn) % 4, there
        path.append(here)
    return path


def _follow(crossings: list[tuple[int, int]]) -> NDArray[np.float64]:
    """Poses in the right lane along the crossings, densest in the corners."""
    nodes = np.array(crossings, dtype=np.float64) * BLOCK_METRES
    ways = np.diff(nodes, axis=0) / BLOCK_METRES
    heading = math.atan2(ways[0, 1], ways[0, 0])
    poses: list[tuple[float, float, float]] = [(*nodes[0], heading)]
    for node, way, onward in zip(nodes[1:-1], ways[:-1], ways[1:], strict=True):
        turn = math.atan2(way[0] * onward[1] - way[1] * onward[0], float(way @ onward))
        if abs(turn) < 1e-9:
            poses.append((*node, heading))
            continue
        left = np.array([-way[1], way[0]]) * math.copysign(1.0, turn)
        start = node - way * _TURN_METRES
        center = start + left * _TURN_METRES
        for part in np.linspace(0.0, 1.0, 25):
            angle = part * abs(turn)
            spot = center + _TURN_METRES * (way * math.sin(angle) - left * math.cos(angle))
            poses.append((*spot, heading + part * turn))
        heading += turn
    poses.append((*nodes[-1], heading))
    path = np.array(poses)
    path[:, 0] += _LANE_METRES * np.sin(path[:, 2])
    path[:, 1] -= _LANE_METRES * np.cos(path[:, 2])
    return path

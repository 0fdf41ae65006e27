# SPDX-License-Identifier: Apache-2.0
"""Drives for a slow origin: through the generated town, through a larger city, and recorded ones."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shmmap.origin.catalogue import Catalogue
from shmmap.segment.layout import SourceStamp
from shmmap.simulation.town import drive as town_path

CELL_M = 20.0
KITTI_S = 0.1  # between two poses of KITTI's odometry data
_HEADINGS = ((1, 0), (0, 1), (-1, 0), (0, -1))

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Drive:
    """Where a vehicle is at which time, and the path of its route.

    Attributes
    ----------
    times_s
        (N,) seconds, ascending, from 0.
    places
        (N, 2) metres, map frame.
    route
        (M, 2) the middle of its lane; the vehicle is a few decimetres beside that.
    """

    name: str
    times_s: Floats
    places: Floats
    route: Floats

    @property
    def length_s(self) -> float:
        """How long it takes."""
        return float(self.times_s[-1])

    @cached_property
    def travelled_m(self) -> Floats:
        """(N,) metres from the beginning."""
        return travelled_m(self.places)

    @property
    def mean_mps(self) -> float:
        """Mean speed, stops included."""
        return float(self.travelled_m[-1]) / self.length_s

    def at(self, now_s: float) -> tuple[float, float]:
        """Where the vehicle is."""
        x, y = (float(np.interp(now_s, self.times_s, column)) for column in self.places.T)
        return x, y

    def times_each(self, step_m: float) -> Floats:
        """When the vehicle has moved on by ``step_m`` again, the beginning included."""
        moved = np.concatenate(([True], np.diff(self.travelled_m) > 0.0))
        marks = np.arange(0.0, float(self.travelled_m[-1]), step_m)
        found: Floats = np.interp(marks, self.travelled_m[moved], self.times_s[moved])
        return found


def town_drive(seed: int = 0, length_m: float = 8000.0, speed_mps: float = 12.0) -> Drive:
    """Through the generated town, at one speed."""
    path = town_path(seed, (32, 32), length_m, 1.0)[:, :2]
    travelled = travelled_m(path)
    return Drive("town", travelled / speed_mps, _beside(path, seed), _route(path))


def city_drive(seed: int = 0, length_m: float = 10_000.0, blocks: int = 20) -> Drive:
    """Through streets 160 m apart, by chance straight on, left or right, with some red lights."""
    random = np.random.Generator(np.random.PCG64([seed, 17]))
    path = city_path(seed, length_m, blocks)
    red = [float(at) for at in np.arange(160.0, length_m, 160.0) if random.random() < 0.06]
    times = _times(path, red, random)
    # a stop is a time without a move: both ends of it are in the table
    return Drive("city", times[0], _beside(path, seed)[times[1].astype(np.intp)], _route(path))


def square_drive(side_m: float = 2400.0, speed_mps: float = 12.0, length_s: float = 600.0) -> Drive:
    """Round a square: straight on for minutes, as on a ring road."""
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1), (0, 0)], dtype=np.float64) * side_m + (300.3, 300.9)
    path = rounded(corners, 12.0)
    path = path[travelled_m(path) <= length_s * speed_mps]
    return Drive("square", travelled_m(path) / speed_mps, _beside(path, 0), _route(path))


def city_path(seed: int, length_m: float, blocks: int = 20) -> Floats:
    """Where such a drive goes: (N, 2) about a metre apart; the city has ``blocks`` blocks on each side."""
    random = np.random.Generator(np.random.PCG64([seed, 18]))
    crossings = _walk(random, blocks, math.ceil(length_m / 160.0) + 2)
    # streets lie across the cells as it happens
    path = rounded(np.array(crossings, dtype=np.float64) * 160.0 + (7.3, 11.9), 12.0)
    return path[travelled_m(path) <= length_m]


def recorded_drive(file: Path) -> Drive:
    """Read a drive from a file of poses: KITTI (12 numbers a line, each 0.1 s) or TUM (t x y z ...).

    KITTI's camera looks along z, to the right is x: these two are the plane of the map.
    """
    rows = np.loadtxt(file)
    if rows.ndim != 2 or rows.shape[1] not in (8, 12):
        raise SystemExit(f"{file}: neither KITTI's poses (12 numbers a line) nor TUM's (8)")
    if rows.shape[1] == 12:
        places, times = rows[:, [11, 3]] * (1.0, -1.0), np.arange(len(rows)) * KITTI_S
    else:
        places, times = rows[:, 1:3], rows[:, 0] - rows[0, 0]
    # the route is smoother than what was driven
    smooth = np.column_stack([np.convolve(column, np.ones(21) / 21, mode="valid") for column in places.T])
    route = np.concatenate([places[:1], smooth, places[-1:]])
    return Drive(file.stem, times.astype(np.float64), np.ascontiguousarray(places), _route(route))


def dense_catalogue(drive: Drive, around_m: float = 500.0) -> Catalogue:
    """Return cells of 20 m everywhere around a drive."""
    low = np.floor((drive.places.min(axis=0) - around_m) / CELL_M).astype(int)
    high = np.ceil((drive.places.max(axis=0) + around_m) / CELL_M).astype(int)
    stamp = SourceStamp(1_000_000, 1, 1)
    return Catalogue.from_cells(
        (f"/map/{x:05}_{y:05}.pcd", (x * CELL_M, y * CELL_M, (x + 1) * CELL_M, (y + 1) * CELL_M), stamp)
        for x in range(low[0], high[0])
        for y in range(low[1], high[1])
    )


def _route(path: Floats) -> Floats:
    """Return a vertex every 3 m, its end included."""
    kept = np.flatnonzero(np.diff(np.floor(travelled_m(path) / 3.0), prepend=-1.0))
    return np.concatenate([path[kept], path[-1:]])


def travelled_m(path: Floats) -> Floats:
    """How far along a path each of its places is, (N,)."""
    steps = np.diff(path, axis=0)
    return np.concatenate(([0.0], np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))))


def _beside(path: Floats, seed: int) -> Floats:
    """Shift a path slowly by up to half a metre to either side: no vehicle keeps the middle of its lane."""
    travelled = travelled_m(path)
    ahead = np.gradient(path, axis=0)
    ahead /= np.maximum(np.hypot(ahead[:, 0], ahead[:, 1]), 1e-9)[:, np.newaxis]
    off_m = 0.25 * (np.sin(travelled / 23.0 + seed) + np.sin(travelled / 61.0 + 2.0 * seed))
    found: Floats = path + off_m[:, np.newaxis] * np.column_stack([-ahead[:, 1], ahead[:, 0]])
    return found


def _walk(random: np.random.Generator, side: int, steps: int) -> list[tuple[int, int]]:
    """Crossings of a square grid, without turning round: straight on with 1/2, else left or right."""
    here, heading = (side // 2, side // 2), int(random.integers(4))
    path = [here]
    while len(path) <= steps:
        heading = (heading + int(random.choice((0, 0, 1, 3)))) % 4
        dx, dy = _HEADINGS[heading]
        there = here[0] + dx, here[1] + dy
        if not (0 <= there[0] <= side and 0 <= there[1] <= side):
            heading = (heading + int(random.choice((1, 3)))) % 4
            continue
        path.append(there)
        here = there
    return path


def rounded(nodes: Floats, radius_m: float) -> Floats:
    """Places about a metre apart, corners as arcs (of a parabola) that begin ``radius_m`` before them."""
    directions = np.diff(nodes, axis=0)
    directions /= np.hypot(directions[:, 0], directions[:, 1])[:, np.newaxis]
    parts = [nodes[:1]]
    for node, before, after in zip(nodes[1:-1], directions[:-1], directions[1:], strict=True):
        begin, end = node - radius_m * before, node + radius_m * after
        share = np.linspace(0.0, 1.0, 24)[:, np.newaxis]
        parts += [_line(parts[-1][-1], begin), (1 - share) ** 2 * begin + 2 * share * (1 - share) * node]
        parts[-1] = parts[-1] + share**2 * end
    path = np.concatenate(parts)
    return path[np.concatenate(([True], np.diff(travelled_m(path)) > 1e-6))]


def _line(begin: Floats, end: Floats) -> Floats:
    count = max(2, math.ceil(float(np.hypot(*(end - begin)))))
    return begin + np.linspace(0.0, 1.0, count)[:, np.newaxis] * (end - begin)


def _times(path: Floats, red_m: list[float], random: np.random.Generator) -> Floats:
    """When a careful driver is where: (2, N) seconds and the row of ``path``.

    At most 15 m/s, 2 m/s² to the side in corners and along the road, and a stop at each red light.
    """
    travelled = travelled_m(path)
    gaps = np.diff(travelled)
    heading = np.unwrap(np.arctan2(*np.gradient(path, axis=0).T[::-1]))
    bend = np.abs(np.gradient(heading, travelled))
    speed = np.minimum(15.0, np.sqrt(2.0 / np.maximum(bend, 1e-6)))
    stops = np.searchsorted(travelled, np.array(red_m) - 8.0)
    speed[stops[stops < len(speed)]] = 0.0
    for i in range(1, len(speed)):
        speed[i] = min(speed[i], math.sqrt(speed[i - 1] ** 2 + 4.0 * gaps[i - 1]))
    for i in range(len(speed) - 2, -1, -1):
        speed[i] = min(speed[i], math.sqrt(speed[i + 1] ** 2 + 4.0 * gaps[i]))
    moving = np.concatenate(([0.0], np.cumsum(gaps / np.maximum(0.5 * (speed[1:] + speed[:-1]), 0.1))))
    times, rows, waited = [], [], 0.0
    for row, time_s in enumerate(moving.tolist()):
        times.append(time_s + waited)
        rows.append(row)
        if row in stops:
            waited += float(random.uniform(5.0, 30.0))
            times.append(time_s + waited)
            rows.append(row)
    return np.array([times, rows], dtype=np.float64)

# SPDX-License-Identifier: Apache-2.0
"""Simulate a LiDAR, and its scans with true poses on a drive through a generated town.

The LiDAR scans a dense cloud, with occlusion, drop-out and noise: each ray returns the nearest point in its
aperture.  There are no mixed pixels and no motion distortion.  Gaps in the cloud are invisible to the LiDAR,
so the cloud should be several times denser than the rays.  Cars and people move beside the drive.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.simulation.town import Town
from shmmap.simulation.town_surfaces import BLOCK_METRES


@dataclass(frozen=True, slots=True, eq=False)
class LidarReturns:
    """The returns of one scan.

    Attributes
    ----------
    xyz
        (N, 3) float32, sensor frame, metres.
    ring
        (N,) uint8, index of the ring: 0 is the lowest.
    source
        (N,) int64: row of the cloud that each return came from.
    """

    xyz: NDArray[np.float32]
    ring: NDArray[np.uint8]
    source: NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Lidar:
    """A spinning LiDAR.

    Attributes
    ----------
    rings
        Number of rings, one above another.
    lowest_deg, highest_deg
        Elevation of the first and the last ring.
    azimuth_deg
        Angle between rays of a ring.
    nearest, farthest
        Range limits, metres: nearer or farther points give no return.
    noise
        Standard deviation of the range, metres.
    dropout
        Share of rays without a return.
    """

    rings: int = 64
    lowest_deg: float = -24.0
    highest_deg: float = 4.0
    azimuth_deg: float = 0.2
    nearest: float = 2.5
    farthest: float = 80.0
    noise: float = 0.02
    dropout: float = 0.05

    def scan(
        self, cloud: NDArray[Any], T_map_sensor: NDArray[np.float64], rng: np.random.Generator
    ) -> LidarReturns:
        """Scan a cloud (N, 3), metres, map frame."""
        R = T_map_sensor[:3, :3]
        away = [cloud[:, axis].astype(np.float64) - T_map_sensor[axis, 3] for axis in range(3)]
        # column by column: several times faster than a product of such narrow matrices
        x, y, z = (away[0] * R[0, axis] + away[1] * R[1, axis] + away[2] * R[2, axis] for axis in range(3))
        distance = np.sqrt(x * x + y * y + z * z)
        near = np.flatnonzero((distance > self.nearest) & (distance < self.farthest))
        x, y, z, distance = x[near], y[near], z[near], distance[near]
        elevation = np.degrees(np.arcsin(z / distance))
        azimuth = np.degrees(np.arctan2(y, x)) + 180.0
        step = (self.highest_deg - self.lowest_deg) / max(1, self.rings - 1)
        ring = np.rint((elevation - self.lowest_deg) / step).astype(np.int64)
        seen = (ring >= 0) & (ring < self.rings)
        columns = math.ceil(360.0 / self.azimuth_deg)
        ray = ring * columns + np.minimum((azimuth / self.azimuth_deg).astype(np.int64), columns - 1)
        ray = np.where(seen, ray, self.rings * columns)
        nearest = np.full(self.rings * columns + 1, np.inf)
        np.minimum.at(nearest, ray, distance)
        hit = np.flatnonzero(distance == nearest[ray])
        hit = hit[np.unique(ray[hit], return_index=True)[1]]  # of equally near points the first
        hit = hit[seen[hit] & (rng.random(len(hit)) >= self.dropout)]
        scale = 1.0 + self.noise * rng.standard_normal(len(hit)) / distance[hit]
        xyz = (np.column_stack((x[hit], y[hit], z[hit])) * scale[:, None]).astype(np.float32)
        return LidarReturns(xyz, ring[hit].astype(np.uint8), near[hit])


_SENSOR_METRES: Final = 1.8  # height of the sensor above the ground
_LIDAR: Final = Lidar(rings=40, azimuth_deg=0.4, farthest=60.0)
_ODOMETRY_DISTANCE: Final = 1.01
_ODOMETRY_TURN: Final = 1.02
_CAR: Final = (4.4, 1.8, 1.5)  # length, width, height, metres
_PERSON: Final = (0.5, 0.5, 1.75)
_ONCOMING_METRES: Final = 3.2  # from the drive's lane to the opposite lane
_PAVEMENT_METRES: Final = 4.5  # from the drive's lane to the pavement
_CAR_GAP: Final = 18.0
_PERSON_GAP: Final = 11.0
_CAR_SPEED: Final = 8.0
_PERSON_SPEED: Final = 1.3
_OBJECT_DENSITY: Final = 600.0  # points a square metre of a car or a person


@dataclass(frozen=True, slots=True, eq=False)
class LidarScan:
    """One scan, with its true pose and labels.

    Attributes
    ----------
    stamp_s
        Seconds since the start of the drive.
    T_map_sensor
        (4, 4) float64, metres.
    xyz
        (N, 3) float32, sensor frame, metres.
    moving
        (N,) uint8: 1 for points on moving objects.
    """

    stamp_s: float
    T_map_sensor: NDArray[np.float64]
    xyz: NDArray[np.float32]
    moving: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class LidarDrive:
    """A drive, and the properties of the LiDAR on the vehicle's roof.

    Attributes
    ----------
    town
        Town of the drive.
    length, step
        Length of the drive, and distance between scans, metres.
    speed
        Speed of the vehicle, metres per second.
    lidar
        The LiDAR; its ``farthest`` limits the simulated surroundings.
    density
        Points per square metre on the surfaces that the LiDAR scans.  The surfaces are those of the map, but
        the points on them differ, so that no scan contains points of the map.
    seed
        Random seed of the traffic and of the LiDAR's noise.
    """

    town: Town
    length: float
    step: float = 2.0
    speed: float = 10.0
    lidar: Lidar = _LIDAR
    density: float = 40.0
    seed: int = 0

    def poses(self) -> Iterator[tuple[float, NDArray[np.float64]]]:
        """Yield time (seconds) and T_map_sensor of every scan."""
        route = self.town.route(length=self.length, step=self.step)
        heights = self.town.ground_height(route[:, 0], route[:, 1]) + _SENSOR_METRES
        for number, ((x, y, heading), z) in enumerate(zip(route.tolist(), heights.tolist(), strict=True)):
            T = np.eye(4)
            T[:2, :2] = [[math.cos(heading), -math.sin(heading)], [math.sin(heading), math.cos(heading)]]
            T[:3, 3] = x, y, z
            yield number * self.step / self.speed, T

    def odometry(self) -> Iterator[tuple[float, NDArray[np.float64]]]:
        """Yield time and odometry pose of every scan, relative to the first scan's pose.

        Wheel odometry with errors: distances are 1 % too long, turns 2 % too wide.
        """
        before, T_odom = np.eye(4), np.eye(4)
        for number, (stamp_s, T) in enumerate(self.poses()):
            if number:
                step = np.linalg.inv(before) @ T
                turn = math.atan2(step[1, 0], step[0, 0]) * _ODOMETRY_TURN
                moved = np.eye(4)
                moved[:2, :2] = [[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]
                moved[:3, 3] = step[:3, 3] * _ODOMETRY_DISTANCE
                T_odom = T_odom @ moved
            before = T
            yield stamp_s, T_odom

    def scans(self) -> Iterator[LidarScan]:
        """Yield the scans one by one."""
        reach, town = self.lidar.farthest, self.town
        traffic = Traffic(town, town.route(length=self.length + reach, step=self.step), seed=self.seed)
        seen = Town(seed=town.seed, blocks=town.blocks, origin=town.origin, density=self.density)
        tile = lru_cache(maxsize=9)(lambda bx, by: seen.tile(bx, by)["xyz"])
        rng = np.random.Generator(np.random.PCG64([self.seed, 11]))
        for stamp_s, T in self.poses():
            x, y = T[:2, 3].tolist()
            parts: list[NDArray[np.floating]] = []
            for block in self._blocks(x, y):
                part = tile(*block)
                parts.append(part[(np.abs(part[:, :2] - (x, y)) < reach).all(axis=1)])
            still = sum(len(part) for part in parts)
            returns = self.lidar.scan(np.concatenate([*parts, traffic.points(stamp_s)]), T, rng)
            moving = (returns.source >= still).astype(np.uint8)
            yield LidarScan(stamp_s, T, returns.xyz, moving)

    def _blocks(self, x: float, y: float) -> list[tuple[int, int]]:
        """Return the blocks within the LiDAR's range of a place."""
        reach = self.lidar.farthest
        spans = [
            range(
                max(0, math.floor((at - reach - start) / BLOCK_METRES)),
                min(count, math.floor((at + reach - start) / BLOCK_METRES) + 1),
            )
            for at, start, count in zip((x, y), self.town.origin, self.town.blocks, strict=True)
        ]
        return [(bx, by) for by in spans[1] for bx in spans[0]]


class Traffic:
    """Cars on the opposite lane of a drive, and people on the pavement beside it.

    Parameters
    ----------
    town
        Town of the drive.
    route
        (N, 3) as returned by `Town.route`.
    seed
        Random seed of the traffic.
    """

    def __init__(self, town: Town, route: NDArray[np.float64], *, seed: int = 0) -> None:
        self._town = town
        self._route = route
        steps = np.hypot(*np.diff(route[:, :2], axis=0).T)
        self._along = np.concatenate([[0.0], np.cumsum(steps)])
        rng = np.random.Generator(np.random.PCG64([seed, 7]))
        length = float(self._along[-1])
        self._cars = _spread(rng, 2 * length, _CAR_GAP)
        self._people = _spread(rng, length, _PERSON_GAP)
        self._car = _box(rng, _CAR)
        self._person = _box(rng, _PERSON)

    def points(self, time_s: float) -> NDArray[np.float64]:
        """Return the points of all moving objects at a time, (N, 3) float64, map frame, metres."""
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
    """Return random places along a length, about ``gap`` apart, metres."""
    places = np.arange(0.0, length, gap)
    return places + rng.uniform(-0.25 * gap, 0.25 * gap, len(places))


def _box(rng: np.random.Generator, size: tuple[float, float, float]) -> NDArray[np.float64]:
    """Return points on the sides and the top of a box that stands on the ground, centred at the origin."""
    length, width, height = size
    sides = ((length, 0, -width / 2), (length, 0, width / 2), (width, 1, -length / 2), (width, 1, length / 2))
    parts = []
    for side, along, offset in sides:
        count = max(1, round(side * height * _OBJECT_DENSITY))
        face = np.full((count, 3), offset)
        face[:, along] = rng.uniform(-side / 2, side / 2, count)
        face[:, 2] = rng.uniform(0, height, count)
        parts.append(face)
    count = max(1, round(length * width * _OBJECT_DENSITY))
    middle = np.array([length, width]) / 2
    top = np.column_stack([rng.uniform(-middle, middle, (count, 2)), np.full(count, height)])
    return np.concatenate([*parts, top])

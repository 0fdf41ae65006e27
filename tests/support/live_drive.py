# SPDX-License-Identifier: Apache-2.0
"""A drive for live maps: as points and poses, as marks, and taken in by a map that is slow and right."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from shmmap.chunks.marking import Marker
from shmmap.chunks.marks import Marks
from shmmap.chunks.occupancy import ScanFilter
from shmmap.live_worker.disk.map_record import MapSettings

RESOLUTION = 0.2
SETTINGS = MapSettings(resolution=RESOLUTION)
FILTER = ScanFilter(0.2, 9.0, -5.0, 5.0)
SCANS = 24


def drive(scans: int = SCANS) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Points and poses along a path that crosses chunks, comes back, and jumps."""
    rng = np.random.default_rng(8)
    found = []
    for number in range(scans):
        pose, yaw = np.eye(4), 0.3 * number
        pose[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
        pose[:3, 3] = [20.0 * math.sin(0.5 * number), -7.0 * number % 31.0, 0.2 * number]
        if number % 6 == 5:
            pose[:3, 3] -= 300.0
        found.append((rng.normal(0.0, 4.0, (150, 3)), pose))
    return found


def marked(scans: int = SCANS) -> list[Marks]:
    """The same as marks."""
    marker = Marker(RESOLUTION, FILTER)
    return [marker.mark(points, pose)[0] for points, pose in drive(scans)]


# -- a rolling map that is right because it is slow: one dictionary, one voxel after the other, no chunks


Voxel = tuple[int, int, int]


def walk(start: Voxel, end: Voxel) -> list[Voxel]:
    """Voxels of a ray, its end excluded: one a step of the longest axis."""
    delta = [abs(b - a) for a, b in zip(start, end, strict=True)]
    sign = [-1 if b < a else 1 for a, b in zip(start, end, strict=True)]
    longest = max(delta)
    error, at, found = [0, 0, 0], list(start), []
    for _ in range(longest):
        found.append((at[0], at[1], at[2]))
        for axis in range(3):
            error[axis] += delta[axis]
            if 2 * error[axis] >= longest:
                at[axis] += sign[axis]
                error[axis] -= longest
    return found


@dataclass
class SlowOccupancy:
    """Log-odds by voxel; a voxel that is not there is unknown."""

    resolution: float
    hit: int = 847
    miss: int = -405
    clamp_min: int = -1992
    clamp_max: int = 3476
    min_range: float = 0.5
    max_range: float = 5.0
    min_z: float = -2.0
    max_z: float = 2.0
    voxels: dict[Voxel, int] = field(default_factory=dict)

    def voxel(self, x: float, y: float, z: float) -> Voxel:
        """The voxel that a point lies in."""
        inverse = 1.0 / self.resolution
        return math.floor(x * inverse), math.floor(y * inverse), math.floor(z * inverse)

    def marks(
        self, points: Iterable[Iterable[float]], pose: list[list[float]]
    ) -> tuple[set[Voxel], set[Voxel]]:
        """Voxels that a scan hits, and those that it passes through."""
        near: set[Voxel] = set()
        far: set[Voxel] = set()
        origin = [row[3] for row in pose]
        for point in points:
            p = [float(value) for value in point]
            if not all(map(math.isfinite, p)) or not self.min_z <= p[2] <= self.max_z:
                continue
            if p[0] * p[0] + p[1] * p[1] + p[2] * p[2] < self.min_range * self.min_range:
                continue
            to = [row[0] * p[0] + row[1] * p[1] + row[2] * p[2] + row[3] for row in pose]
            d = [a - b for a, b in zip(to, origin, strict=True)]
            squared = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
            if squared >= self.max_range * self.max_range:
                length = math.sqrt(squared)
                cut = [o + part / length * self.max_range for o, part in zip(origin, d, strict=True)]
                far.add(self.voxel(*cut))
            else:
                near.add(self.voxel(*to))
        start = self.voxel(*origin)
        passed = far - near
        for end in near | far:
            passed.update(walk(start, end))
        return near, passed - near

    def add(self, hits: Iterable[Voxel], misses: Iterable[Voxel]) -> None:
        """Add evidence; what comes to 0 is unknown."""
        for voxels, worth in ((hits, self.hit), (misses, self.miss)):
            for voxel in voxels:
                value = min(max(self.voxels.get(voxel, 0) + worth, self.clamp_min), self.clamp_max)
                if value:
                    self.voxels[voxel] = value
                else:
                    self.voxels.pop(voxel, None)

    def insert(self, points: Iterable[Iterable[float]], pose: list[list[float]]) -> None:
        """Take a scan in."""
        self.add(*self.marks(points, pose))

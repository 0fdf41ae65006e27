# SPDX-License-Identifier: Apache-2.0
"""A LiDAR looking at a dense cloud: which points it returns, with occlusion, drop-out and noise.

Each ray returns the nearest point in its aperture.  There are no mixed pixels and no motion
distortion, and what the cloud does not hold is not seen; so the cloud should be several times denser
than the rays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Lidar", "LidarReturns"]


@dataclass(frozen=True, slots=True, eq=False)
class LidarReturns:
    """One scan.

    Attributes
    ----------
    xyz
        (N, 3) float32, sensor frame, metres.
    ring
        (N,) uint8: 0 is the lowest.
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
        Rays above one another.
    lowest_deg, highest_deg
        Elevation of the first and the last ring.
    azimuth_deg
        Between rays of a ring.
    nearest, farthest
        Metres; nothing is returned from nearer or farther.
    noise
        Of the range, one standard deviation, metres.
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
        """Look at a cloud, (N, 3), metres, map frame."""
        R = T_map_sensor[:3, :3]
        away = [cloud[:, axis].astype(np.float64) - T_map_sensor[axis, 3] for axis in range(3)]
        # column by column: several times faster than a product of matrices as narrow as these
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
        hit = hit[np.unique(ray[hit], return_index=True)[1]]  # of equally near ones the first
        hit = hit[seen[hit] & (rng.random(len(hit)) >= self.dropout)]
        scale = 1.0 + self.noise * rng.standard_normal(len(hit)) / distance[hit]
        xyz = (np.column_stack((x[hit], y[hit], z[hit])) * scale[:, None]).astype(np.float32)
        return LidarReturns(xyz, ring[hit].astype(np.uint8), near[hit])

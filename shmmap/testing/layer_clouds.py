# SPDX-License-Identifier: Apache-2.0
"""Clouds that layers are tried on: ordinary ones, and every corner that a builder may stumble over."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["CORNERS", "corner", "surface"]

CORNERS: Final = (
    "origin", "negative", "large_f4", "large_f8", "borders", "empty", "one_point", "duplicates", "not_finite",
    "flat", "far_apart",
)  # fmt: skip

MOVED: Final[NDArray[Any]] = np.array([89570.0, 42300.0, 3.0])


def surface(rng: np.random.Generator, points: int, size_m: float = 20.0) -> NDArray[np.float64]:
    """Gently hilly ground with a wall: (points, 3), metres, x and y in 0 .. size_m."""
    xy = rng.uniform(0, size_m, (points, 2))
    z = np.sin(xy[:, 0] / 4) + rng.normal(0, 0.02, points)
    wall = rng.random(points) < 0.3
    xy[wall, 0] = size_m / 3 + rng.normal(0, 0.02, wall.sum())
    z[wall] += rng.uniform(0, 4, wall.sum())
    return np.column_stack([xy, z])


def corner(name: str, points: int = 600) -> Any:
    """One cloud of `CORNERS`, (N, 3) float32 or float64."""
    rng = np.random.default_rng(CORNERS.index(name))
    base: NDArray[Any] = surface(rng, points)
    if name == "origin":
        return (base - [10, 10, 0]).astype(np.float32)
    if name == "negative":
        return (base - [1000, 2000, 50]).astype(np.float32)
    if name == "large_f4":
        base = base + MOVED
        return base.astype(np.float32)
    if name == "large_f8":
        return base + MOVED
    if name == "borders":  # exactly on faces of voxels, and a hair to either side
        steps = rng.integers(-4, 5, (points, 3)).astype(np.float32) * np.float32(0.5)
        hairs: NDArray[Any] = np.nextafter(steps, steps + rng.integers(-1, 2, steps.shape).astype(np.float32))
        return hairs
    if name == "empty":
        return np.empty((0, 3), np.float32)
    if name == "one_point":
        return np.array([[-3.25, 4.5, 0.125]], np.float32)
    if name == "duplicates":
        return np.repeat(base[:40], 15, axis=0).astype(np.float32)
    if name == "not_finite":
        cloud = base.astype(np.float32)
        cloud[::7, 0] = np.nan
        cloud[3::11, 2] = np.inf
        cloud[5::13, 1] = -np.inf
        return cloud
    if name == "flat":
        base[:, 2] = 1.0
        return base.astype(np.float32)
    if name != "far_apart":
        raise KeyError(name)
    # no table can cover the box
    cloud = base.astype(np.float64)
    cloud[0] = [3e6, -4e6, 2e6]
    return cloud

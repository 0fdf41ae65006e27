# SPDX-License-Identifier: Apache-2.0
"""Coordinates for builders that look at the points around each point."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from shmmap.layers.contract import PointTable

__all__ = ["local_coordinates"]


def local_coordinates(points: PointTable, finite: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Coordinates of a cell's finite points, then of its halo, (N + M, 3) float64, about the first point.

    Open3D's own sums would lose digits far from the map's origin.
    """
    own = points.xyz[finite].astype(np.float64)
    if points.halo is None or not len(points.halo) or not len(own):
        return own - own[:1]
    halo = points.halo[np.isfinite(points.halo).all(axis=1)].astype(np.float64)
    local: NDArray[np.float64] = np.concatenate([own, halo]) - own[:1]
    return local

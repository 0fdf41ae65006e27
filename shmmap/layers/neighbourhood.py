# SPDX-License-Identifier: Apache-2.0
"""Open3D for builders that look at the points around each point, loaded when the first one runs."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from shmmap.errors import ShmmapError
from shmmap.layers.contract import PointTable

__all__ = ["load_open3d", "local_coordinates"]


def load_open3d(layer: str) -> Any:
    """Return the open3d module: 1-2 s and 100-200 MB, once in a process.

    Raises
    ------
    ShmmapError
        If it cannot be loaded; the hint says what it lacks.
    """
    try:
        import open3d
    except ImportError as error:
        raise ShmmapError(
            f"Open3D cannot be loaded to build {layer}: {error}",
            hint="it needs the system packages libegl1 libgl1 libx11-6 libusb-1.0-0",
        ) from error
    return open3d


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

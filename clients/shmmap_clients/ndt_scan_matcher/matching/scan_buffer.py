# SPDX-License-Identifier: Apache-2.0
"""The scan's buffer: of fixed size, filled without allocation, cut evenly where a scan is larger."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest

__all__ = ["ScanBuffer"]


class ScanBuffer:
    """Room for a scan of at most ``most`` points, as numbers of ``dtype``."""

    def __init__(self, most: int, dtype: np.dtype[Any] | type = np.float64) -> None:
        self._buffer: NDArray[Any] = np.empty((most, 3), dtype)
        self._count = 0

    @property
    def points(self) -> NDArray[Any]:
        """The scan, (N, 3), metres."""
        return self._buffer[: self._count]

    def take(self, points: NDArray[np.floating]) -> int:
        """Take a scan; returns how many points were left out.

        Point i of the kept m is floor(i n / m) of the given n: the same ones each time, and evenly over
        the whole scan, whatever its order.  Points that are not finite find no neighbour.
        """
        if points.ndim != 2 or points.shape[1] != 3:
            raise BadRequest(f"a scan must have shape (N, 3), this one has {points.shape}")
        given, most = len(points), len(self._buffer)
        self._count = min(given, most)
        if given <= most:
            with np.errstate(over="ignore"):
                self._buffer[:given] = points
        else:
            with np.errstate(over="ignore"):
                np.copyto(self._buffer, points[np.arange(most) * given // most], casting="same_kind")
        return given - self._count

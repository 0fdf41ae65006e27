# SPDX-License-Identifier: Apache-2.0
"""The ground of the generated town: smooth hills, with streets a curb's height below the blocks."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["BLOCK_METRES", "CURB_METRES", "ROAD_HALF_METRES", "Ground"]

BLOCK_METRES = 80.0
"""Distance between street centre lines, in x and in y."""
ROAD_HALF_METRES = 4.0
"""From a street's centre line to its curb."""
CURB_METRES = 0.12

# Four waves: (wavelength, height) in metres; together slopes stay below 10 %.
_WAVES = ((913.0, 6.0), (541.0, 3.0), (277.0, 1.0), (131.0, 0.25))


class Ground:
    """Height of the ground as a function of town coordinates (metres from the town's corner)."""

    def __init__(self, seed: int) -> None:
        rng = np.random.Generator(np.random.PCG64([seed, 1]))
        angles, self._phases = rng.uniform(0.0, 2.0 * np.pi, (2, len(_WAVES)))
        lengths = np.array([length for length, _ in _WAVES])
        self._heights = np.array([height for _, height in _WAVES])
        self._kx = 2.0 * np.pi * np.cos(angles) / lengths
        self._ky = 2.0 * np.pi * np.sin(angles) / lengths

    def terrain(self, x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.float64]:
        """Height of the hills alone, metres."""
        z = np.zeros(np.broadcast(x, y).shape)
        for kx, ky, phase, height in zip(self._kx, self._ky, self._phases, self._heights, strict=True):
            z += height * np.sin(kx * x + (ky * y + phase))
        return z

    def height(self, x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.float64]:
        """Height of the ground, metres: the hills, plus the curb away from the streets."""
        return self.terrain(x, y) + CURB_METRES * (street_distance(x, y) >= ROAD_HALF_METRES)


def street_distance(x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.float64]:
    """Distance to the nearest street centre line, metres."""
    across_x = np.abs(x - BLOCK_METRES * np.rint(x / BLOCK_METRES))
    across_y = np.abs(y - BLOCK_METRES * np.rint(y / BLOCK_METRES))
    return np.minimum(across_x, across_y)

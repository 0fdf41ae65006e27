# SPDX-License-Identifier: Apache-2.0
"""Points seen from above, as a small PNG: colour is height above the ground."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from shmmap.formats.png import png_bytes

__all__ = ["HeightImage"]

Ground: TypeAlias = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[Any]]

_NOTHING: Final = 0  # palette entry of pixels without a point
_GROUND_LEVELS: Final = 16  # entries for the ground, dark asphalt to light paint
_HEIGHT_LEVELS: Final = 100  # entries each for plants and for buildings, low to high
_GROUND_METRES: Final = 0.3  # what is lower belongs to the ground
_LOW_METRES, _HIGH_METRES = 0.3, 25.0
_PLANT_INTENSITY: Final = 52.0  # the town's leaves reflect more than its roofs

# where along the scale (0 to 1), and the colour there; between two of them it is mixed
_GROUND_COLOURS: Final = (
    (0.0, (176, 176, 178)),
    (0.25, (214, 211, 205)),
    (0.6, (233, 230, 222)),
    (1.0, (255, 255, 255)),
)
_PLANT_COLOURS: Final = ((0.0, (190, 208, 168)), (0.35, (142, 178, 120)), (1.0, (78, 122, 84)))
_BUILDING_COLOURS: Final = (
    (0.0, (206, 178, 150)),
    (0.4, (190, 142, 104)),
    (0.7, (150, 92, 72)),
    (1.0, (92, 52, 52)),
)


class HeightImage:
    """Keeps height and intensity of the highest point of every pixel.

    Parameters
    ----------
    box
        What the image shows: (min_x, min_y, max_x, max_y), metres, map frame.
    pixel
        Side of a pixel, metres.
    """

    def __init__(self, box: tuple[float, float, float, float], pixel: float = 0.5) -> None:
        self.box = box
        self._pixel = pixel
        self._columns = max(1, round((box[2] - box[0]) / pixel))
        self._rows = max(1, round((box[3] - box[1]) / pixel))
        self._top = np.full(self._rows * self._columns, -np.inf, dtype=np.float32)
        self._intensity = np.zeros(self._rows * self._columns, dtype=np.float32)

    def add(self, xyz: NDArray[Any], intensity: NDArray[Any]) -> None:
        """Add points: (N, 3), metres, map frame, and (N,), 0 to 255; those outside the box are ignored."""
        column = np.floor((xyz[:, 0] - self.box[0]) / self._pixel).astype(np.intp)
        row = np.floor((self.box[3] - xyz[:, 1]) / self._pixel).astype(np.intp)
        inside = (column >= 0) & (column < self._columns) & (row >= 0) & (row < self._rows)
        pixel, z = row[inside] * self._columns + column[inside], xyz[inside, 2].astype(np.float32)
        np.maximum.at(self._top, pixel, z)
        highest = z >= self._top[pixel]
        self._intensity[pixel[highest]] = intensity[inside][highest]

    def png(self, ground: Ground) -> bytes:
        """Return the image, north up.

        Parameters
        ----------
        ground
            Height of the ground at (x, y), arrays of metres.
        """
        x = self.box[0] + (np.arange(self._columns) + 0.5) * self._pixel
        y = self.box[3] - (np.arange(self._rows) + 0.5) * self._pixel
        above = self._top - ground(np.tile(x, self._rows), np.repeat(y, self._columns))
        # a square root gives the heights of hedges as many colours as those of towers
        scale = np.sqrt(np.clip((above - _LOW_METRES) / (_HIGH_METRES - _LOW_METRES), 0.0, 1.0))
        height = (scale * (_HEIGHT_LEVELS - 1)).astype(np.uint8)
        shade = (np.clip(self._intensity / 128.0, 0.0, 1.0) * (_GROUND_LEVELS - 1)).astype(np.uint8)
        plants = 1 + _GROUND_LEVELS
        raised = np.where(
            self._intensity > _PLANT_INTENSITY, plants + height, plants + _HEIGHT_LEVELS + height
        )
        seen = np.where(above < _GROUND_METRES, 1 + shade, raised)
        pixels = np.where(np.isfinite(self._top), seen, _NOTHING).astype(np.uint8)
        palette = b"\xff\xff\xff" + b"".join(
            (
                _mixed(_GROUND_COLOURS, _GROUND_LEVELS),
                _mixed(_PLANT_COLOURS, _HEIGHT_LEVELS),
                _mixed(_BUILDING_COLOURS, _HEIGHT_LEVELS),
            )
        )
        return png_bytes(pixels.reshape(self._rows, self._columns), palette)


def _mixed(stops: Sequence[tuple[float, tuple[int, int, int]]], levels: int) -> bytes:
    at = np.linspace(0.0, 1.0, levels)
    channels = [np.interp(at, [place for place, _ in stops], [rgb[i] for _, rgb in stops]) for i in range(3)]
    return bytes(np.stack(channels, axis=1).round().astype(np.uint8).tobytes())

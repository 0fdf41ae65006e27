# SPDX-License-Identifier: Apache-2.0
"""Clouds whose coordinates are longitude and latitude, which no map in metres can be made of.

Divided into cells of metres, a whole town of them falls into one cell.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["GEOGRAPHIC_SYSTEM", "degrees_warning", "is_geographic"]

GEOGRAPHIC_SYSTEM: Final = (
    "its coordinate system is geographic: x and y are degrees, not metres; convert it to a metric "
    "system first,"
    " such as UTM"
)

_MOST_DEGREES: Final = 5.0  # of x and of y; larger clouds are divided by other means
_FLATNESS: Final = 20.0  # heights are in metres, so such a cloud seems to be far higher than wide
_OFF_ORIGIN: Final = 1.0  # what small thing stands at the origin may be as slender as that
_MODEL_TYPE_KEY: Final = 1024  # GTModelTypeGeoKey of GeoTIFF; 2 is geographic
_GEOGRAPHIC_MODEL: Final = 2


def degrees_warning(lowest: NDArray[np.float64], highest: NDArray[np.float64]) -> str:
    """Return a warning where bounds ((3,) each) look like degrees, else an empty text.

    They do where x and y are possible as longitude and latitude, span few degrees, and heights span many
    times as much: a town is 0.05 degrees wide and 50 m high.
    """
    if not (np.isfinite(lowest).all() and np.isfinite(highest).all()):
        return ""
    farthest = np.maximum(np.abs(lowest), np.abs(highest))
    spans = highest - lowest
    wide = float(max(spans[0], spans[1]))
    if not (farthest[0] <= 180.0 and farthest[1] <= 90.0 and max(farthest[:2]) > _OFF_ORIGIN):
        return ""
    if not (0.0 < wide <= _MOST_DEGREES and spans[2] > _FLATNESS * wide):
        return ""
    return (
        f"x and y look like degrees, not metres: x {lowest[0]:.6g} .. {highest[0]:.6g},"
        f" y {lowest[1]:.6g} .. {highest[1]:.6g}; if they are longitude and latitude, convert the cloud to a"
        " metric system first, such as UTM"
    )


def is_geographic(header: Any) -> bool:
    """Whether a LAS header (laspy's) names a geographic coordinate system; needs no projection library."""
    for record in header.vlrs:
        kind = type(record).__name__
        if kind == "WktCoordinateSystemVlr":
            return str(record.string).lstrip().upper().startswith(("GEOGCS[", "GEOGCRS[", "GEODCRS["))
        if kind == "GeoKeyDirectoryVlr":
            models = [key.value_offset for key in record.geo_keys if key.id == _MODEL_TYPE_KEY]
            if models:
                return int(models[0]) == _GEOGRAPHIC_MODEL
    return False

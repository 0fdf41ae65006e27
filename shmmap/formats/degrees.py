# SPDX-License-Identifier: Apache-2.0
"""Clouds whose coordinates are no metres: longitude and latitude, which no map can be made of, and feet.

Divided into cells of metres, a whole town of them falls into one cell.
"""

from __future__ import annotations

import re
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap.formats.coordinate_system import METRE, CoordinateSystem, LengthUnit

__all__ = ["GEOGRAPHIC_SYSTEM", "degrees_warning", "unit_text", "unit_warnings", "units_text"]

GEOGRAPHIC_SYSTEM: Final = (
    "its coordinate system is geographic: x and y are degrees, not metres; convert it to a metric "
    "system first,"
    " such as UTM"
)

_MOST_DEGREES: Final = 5.0  # of x and of y; larger clouds are divided by other means
_FLATNESS: Final = 20.0  # heights are in metres, so such a cloud seems to be far higher than wide
_OFF_ORIGIN: Final = 1.0  # what small thing stands at the origin may be as slender as that


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


def unit_warnings(crs: CoordinateSystem | None) -> tuple[str, ...]:
    """Return what has to be said of a file's units: that they are degrees, or no metres."""
    if crs is None:
        return ()
    plane, height = crs.units
    said = [GEOGRAPHIC_SYSTEM] if crs.geographic else []
    if crs.geographic and height != METRE:
        said.append(f"heights are in {unit_text(height)}, not metres")
    elif not crs.geographic and (plane, height) != (METRE, METRE):
        said.append(f"coordinates are not in metres: {units_text(plane, height)}")
    return tuple(said)


def units_text(plane: LengthUnit, height: LengthUnit) -> str:
    """Say units in the plane and in height, each with its length."""
    if plane == height:
        return f"x, y and z are in {unit_text(plane)}"
    return f"x and y are in {unit_text(plane)}, z in {unit_text(height)}"


def unit_text(unit: LengthUnit) -> str:
    """Name a unit with its length."""
    if unit == METRE:
        return "metres"
    name = re.sub(r"\bfoot\b", "feet", unit.name)
    return f"{name} ({unit.metres:.12g} m)" if unit.metres else f"{name} (of a length not known)"

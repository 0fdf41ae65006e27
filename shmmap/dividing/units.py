# SPDX-License-Identifier: Apache-2.0
"""Units of the inputs: a map is in metres, and what is not has to be converted, or is refused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from shmmap.dividing.row_layout import NO_SCALE
from shmmap.dividing.sources import Source
from shmmap.errors import BadRequest, MapDataError
from shmmap.formats.causes import refusal
from shmmap.formats.coordinate_system import FEET, METRE, UNITS, CoordinateSystem, LengthUnit
from shmmap.formats.degrees import units_text

__all__ = ["InputUnits", "choose_units"]

_BY_NAME: Final = {"m": METRE, **FEET}


@dataclass(frozen=True, slots=True)
class InputUnits:
    """What the inputs have in common.

    Attributes
    ----------
    scales
        Of each source: metres per unit in the plane and in height.
    crs
        Name of their coordinate system; empty where they say none.
    notes
        What a person should know.
    """

    scales: tuple[tuple[float, float], ...]
    crs: str
    notes: tuple[str, ...]

    @property
    def unit_m(self) -> tuple[float, float]:
        """The scale of all sources; 1 where they differ."""
        return self.scales[0] if len(set(self.scales)) == 1 else NO_SCALE


def choose_units(sources: Sequence[Source], unit: str, vertical_unit: str) -> InputUnits:
    """Choose how coordinates become metres.

    Parameters
    ----------
    unit
        Of x and y, one of `UNITS`, and of z where neither ``vertical_unit`` nor the file says another.
        Empty: metres; a file that says otherwise is refused.
    vertical_unit
        Of z, likewise.

    Raises
    ------
    BadRequest
        There is no such unit.
    MapDataError
        ``not_metres``, with the factor; or ``different_systems``.
    """
    for name, value in (("unit", unit), ("vertical unit", vertical_unit)):
        if value and value not in UNITS:
            raise BadRequest(f"{name} {value!r} is not one of {', '.join(UNITS)}")
    notes: list[str] = []
    scales = [_scale(source, unit, vertical_unit, notes) for source in sources]
    return InputUnits(tuple(scales), _common_system(sources, notes), tuple(dict.fromkeys(notes)))


def _scale(source: Source, unit: str, vertical_unit: str, notes: list[str]) -> tuple[float, float]:
    crs = source.crs or CoordinateSystem()
    said = crs.units
    if crs.geographic and unit in FEET:
        raise refusal("not_metres", "x and y are degrees, which no factor converts", path=source.path)
    plane = _BY_NAME.get(unit, said[0])
    height = _BY_NAME.get(vertical_unit) or (
        said[1] if vertical_unit == "auto" or unit in ("", "auto") or crs.height is not None else plane
    )
    if not plane.metres or not height.metres:
        raise refusal(
            "not_metres", units_text(plane, height), path=source.path,
            hint=f"say it by --unit and --vertical-unit: {', '.join(_BY_NAME)}",
        )  # fmt: skip
    if (not unit and plane != METRE) or (not unit and not vertical_unit and height != METRE):
        raise _not_metres(source.path, plane, height)
    if (plane, height) != (METRE, METRE):
        notes.append(f"converted to metres: {units_text(plane, height)}")
    elif said != (METRE, METRE):
        notes.append(f"taken as metres, although the file says: {units_text(*said)}")
    return plane.metres, height.metres


def _not_metres(path: str, plane: LengthUnit, height: LengthUnit) -> MapDataError:
    factors = (
        f"{plane.metres:.12g}" if plane == height else f"{plane.metres:.12g}, heights by {height.metres:.12g}"
    )
    return refusal(
        "not_metres",
        f"its coordinates are not in metres: {units_text(plane, height)}",
        path=path,
        hint=f"--unit auto multiplies them by {factors}; --unit m takes the numbers as metres",
    )


def _common_system(sources: Sequence[Source], notes: list[str]) -> str:
    """Return the name of the inputs' system; refuses systems of different codes."""
    systems = {source.crs.label: source for source in sources if source.crs is not None and source.crs.label}
    codes: dict[int, Source] = {}
    for source in systems.values():
        if source.crs is not None and source.crs.epsg:
            codes.setdefault(source.crs.epsg, source)
    if len(codes) > 1:
        (one, first), (other, second) = list(codes.items())[:2]
        raise MapDataError(
            f"its coordinate system is EPSG:{other}, that of {first.path} EPSG:{one}", path=second.path,
            cause="different_systems", hint="convert them to the same system, or divide them apart",
        )  # fmt: skip
    if len(systems) > 1:
        notes.append(f"the inputs name their coordinate systems differently: {', '.join(list(systems)[:4])}")
    return next(iter(systems), "")

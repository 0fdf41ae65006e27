# SPDX-License-Identifier: Apache-2.0
"""Units and frame of a map: convert to metres or refuse, and move coordinates that float32 cannot hold.

float32 steps by 1 mm from 8192 m on and by 31 mm from 262144 m on.  Autoware and all other programs that read
maps through PCL support float32 only, and read a float64 cloud as zeros.  So coordinates with more precision
are moved to a frame near them, the same for the whole map; the translation back is stored beside the map.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from shmmap.columns import Bounds
from shmmap.dividing.lattice import CellLattice
from shmmap.dividing.sources import NO_MOVE, NO_SCALE, Bound3, RowLayout, Source
from shmmap.errors import BadRequest, MapDataError
from shmmap.formats.coordinate_system import (
    GEOGRAPHIC_SYSTEM,
    LENGTHS,
    METRE,
    UNITS,
    CoordinateSystem,
    LengthUnit,
    units_text,
)
from shmmap.formats.point_checks import FLOAT32_REACH_M
from shmmap.formats.source_file import refusal

_SCAN_POINTS: Final = 1 << 20
_ROUNDING: Final = 1.001  # bounds in headers are rounded

Extremes = NDArray[np.float64]

Translation = tuple[float, float, float] | Literal["auto", "none"]


@dataclass(frozen=True, slots=True)
class Frame:
    """The frame of the divided map.

    Attributes
    ----------
    move
        Translation of the inputs' points, metres.
    axis
        Type of x, y and z: float32 or float64.
    notes
        Remarks about the frame for the user.
    reach_m
        Beyond this coordinate, precision of the inputs is lost.
    """

    move: tuple[float, float, float]
    axis: np.dtype[np.floating]
    notes: tuple[str, ...] = ()
    reach_m: float = math.inf

    @property
    def origin(self) -> tuple[float, float, float]:
        """Origin of the map's frame in the frame of the inputs, metres."""
        x, y, z = (0.0 - part for part in self.move)
        return x, y, z

    def check(self, extremes: Extremes) -> None:
        """Refuse points (2, 3: least, greatest) outside the bounds that the files' headers claim.

        Raises
        ------
        MapDataError
            The points lie so far outside that float32 lost more precision than allowed.
        """
        reach = float(np.abs(extremes).max())
        if self.axis.itemsize == 4 and math.isfinite(reach) and reach > self.reach_m * _ROUNDING:
            raise MapDataError(
                f"points lie up to {reach:.0f} m from the map's origin, beyond what the headers say",
                cause="bad_bounds",
                hint="give --translate X,Y,Z or none",
            )


def _source_bounds(sources: Sequence[Source], *, believe: bool = True) -> Bound3:
    """Return the bounds of all finite points, from the headers if possible, else by reading the sources.

    NaN if there is no finite point.  Without ``believe`` headers are not used: their bounds include points
    that are left out.
    """
    bounds = Bounds()
    for source in sources:
        if believe and source.claimed_bounds is not None:
            if source.points:
                plane, height = source.scale
                bounds.add(np.array(source.claimed_bounds, np.float64) * (plane, plane, height))
            continue
        source.begin(RowLayout(source.row, scale=source.scale), 0)
        rows = np.empty(_SCAN_POINTS, source.row)
        while count := source.read(rows):
            bounds.add(np.column_stack([rows[axis][:count] for axis in "xyz"]))
        source.close()
    return bounds.result()


def choose_frame(
    sources: Sequence[Source],
    row: np.dtype[np.void],
    lattice: CellLattice,
    translation: Translation,
    before: tuple[float, float, float] | None = None,
) -> Frame:
    """Choose the frame of a map of ``sources``, whose common row type is ``row``.

    Parameters
    ----------
    translation
        Numbers to add to x, y and z; ``none`` to keep the frame; ``auto`` to move it if the
        inputs are float64 and float32 would lose more than half a millimetre.  An automatic frame
        lies at whole metres and whole cells, so that the cells stay the same squares of ground.
    before
        With ``auto``, the translation to prefer if float32 is precise enough with it.
    """
    if row["x"].itemsize == 4 and not isinstance(translation, tuple):
        return Frame(NO_MOVE, np.dtype(np.float32))
    frame = frame_between(_source_bounds(sources), row["x"], lattice, translation, before)
    claimed = any(source.claimed_bounds is not None for source in sources)
    if claimed and translation == "auto" and frame.axis.itemsize == 8:
        bounds = _source_bounds(sources, believe=False)
        frame = frame_between(bounds, row["x"], lattice, translation, before)
    return frame


def frame_between(
    bounds: Bound3,
    axis: np.dtype[np.floating],
    lattice: CellLattice,
    translation: Translation,
    before: tuple[float, float, float] | None = None,
) -> Frame:
    """Choose the frame as `choose_frame` does, for given bounds and type of coordinates."""
    single, double = np.dtype(np.float32), np.dtype(np.float64)
    low, high = bounds
    if not np.isfinite(low).all():
        return Frame(NO_MOVE if isinstance(translation, str) else translation, single)
    if isinstance(translation, tuple):
        reach = _reach(low, high, translation)
        if reach < FLOAT32_REACH_M or (axis.itemsize == 4 and reach <= _reach(low, high, NO_MOVE)):
            return Frame(translation, single)
        return Frame(translation, double, (_kept_note(reach),))
    reach = _reach(low, high, NO_MOVE)
    if translation == "auto" and before is not None and _reach(low, high, before) < FLOAT32_REACH_M:
        notes = (_moved_note(before, reach),) if before != NO_MOVE else ()
        return Frame(before, single, notes, FLOAT32_REACH_M)
    if reach < FLOAT32_REACH_M:
        return Frame(NO_MOVE, single, (), FLOAT32_REACH_M)
    if translation == "none":
        return Frame(NO_MOVE, double, (_kept_note(reach),))
    step = lattice.common_step()
    move = [0.0, 0.0, 0.0]
    for number in range(3):
        if max(abs(low[number]), abs(high[number])) >= FLOAT32_REACH_M:
            unit = step if number < 2 else Fraction(1)
            # exact, rounded once: a multiple of a decimal size keeps few decimals
            move[number] = 0.0 - float(round((low[number] + high[number]) / 2 / float(unit)) * unit)
    x, y, z = move
    moved = _reach(low, high, (x, y, z))
    if moved >= FLOAT32_REACH_M:
        return Frame(NO_MOVE, double, (_kept_note(moved),))
    return Frame(
        (x, y, z),
        single,
        (_moved_note(move, reach),),
        FLOAT32_REACH_M,
    )


def _reach(low: Extremes, high: Extremes, move: tuple[float, float, float]) -> float:
    return float(max(np.abs(low + move).max(), np.abs(high + move).max()))


def _loss(reach: float) -> str:
    """Return the most that float32 loses at a coordinate, in millimetres with two digits."""
    loss_mm = float(np.spacing(np.float32(reach))) / 2 * 1e3
    return f"{np.format_float_positional(loss_mm, 2, fractional=False, trim='-')} mm"


def _moved_note(move: Sequence[float], reach: float) -> str:
    x, y, z = move
    return (
        f"moved by ({x:.12g}, {y:.12g}, {z:.12g}) m: float32 would have lost up to {_loss(reach)} "
        "where the points were; `shmmap divide --translate none` keeps their frame, in float64"
    )


def _kept_note(reach: float) -> str:
    return (
        f"x, y and z stay float64: float32 would lose up to {_loss(reach)}; "
        "Autoware's loader reads float32 only"
    )


_BY_NAME: Final = {"m": METRE, **LENGTHS}


@dataclass(frozen=True, slots=True)
class InputUnits:
    """Common units and coordinate system of the inputs.

    Attributes
    ----------
    scales
        Metres per unit of each source, in the plane and in height.
    crs
        Name of the inputs' coordinate system; empty if they name none.
    notes
        Remarks about the units for the user.
    """

    scales: tuple[tuple[float, float], ...]
    crs: str
    notes: tuple[str, ...]

    @property
    def unit_m(self) -> tuple[float, float]:
        """Metres per unit of all sources; 1 if they differ."""
        return self.scales[0] if len(set(self.scales)) == 1 else NO_SCALE


def choose_units(sources: Sequence[Source], unit: str, vertical_unit: str) -> InputUnits:
    """Choose the conversion of coordinates to metres.

    Parameters
    ----------
    unit
        Unit of x and y, one of `UNITS`; also of z unless ``vertical_unit`` or the file names another.  Empty:
        metres, and a file that names another unit is refused.
    vertical_unit
        Unit of z, likewise.

    Raises
    ------
    BadRequest
        The unit is not one of `UNITS`.
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
    if crs.geographic and unit != "m":
        raise refusal(
            "not_metres",
            GEOGRAPHIC_SYSTEM,
            path=source.path,
            hint="no factor converts degrees; --unit m takes the numbers as metres, if the file is wrong",
        )
    plane = _BY_NAME.get(unit, said[0])
    height = _BY_NAME.get(vertical_unit) or (
        said[1] if vertical_unit == "auto" or unit in ("", "auto") or crs.height is not None else plane
    )
    if not plane.metres or not height.metres:
        raise refusal(
            "not_metres",
            units_text(plane, height),
            path=source.path,
            hint=f"say it by --unit and --vertical-unit: {', '.join(_BY_NAME)}",
        )
    if (not unit and plane != METRE) or (not unit and not vertical_unit and height != METRE):
        raise _not_metres(source.path, plane, height)
    if (plane, height) != (METRE, METRE):
        stated = (crs.plane or crs.height) is not None and (plane, height) != said
        other = f", although the file says: {units_text(*said)}" if stated else ""
        notes.append(f"converted to metres: {units_text(plane, height)}{other}")
    elif crs.geographic:
        notes.append(f"taken as metres, although the file says: {GEOGRAPHIC_SYSTEM}")
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
    """Return the name of the inputs' coordinate system; refuse inputs whose codes differ."""
    systems = {source.crs.label: source for source in sources if source.crs is not None and source.crs.label}
    codes: dict[int, Source] = {}
    for source in systems.values():
        if source.crs is not None and source.crs.epsg:
            codes.setdefault(source.crs.epsg, source)
    if len(codes) > 1:
        (one, first), (other, second) = list(codes.items())[:2]
        raise MapDataError(
            f"its coordinate system is EPSG:{other}, that of {first.path} EPSG:{one}",
            path=second.path,
            cause="different_systems",
            hint="convert them to the same system, or divide them apart",
        )
    if len(systems) > 1:
        notes.append(f"the inputs name their coordinate systems differently: {', '.join(list(systems)[:4])}")
    return next(iter(systems), "")

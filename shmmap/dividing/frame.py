# SPDX-License-Identifier: Apache-2.0
"""Whether points keep their frame, and whether float32 can hold them.

float32 steps by 1 mm from 8192 m on and by 31 mm from 262144 m on.  Autoware, and whatever else reads
maps by PCL, knows float32 only, and reads a float64 cloud as zeros.  So coordinates that came with more
precision are moved to a frame near them, the same for the whole map; the way back is kept beside it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from shmmap.dividing.lattice import CellLattice
from shmmap.dividing.row_layout import NO_MOVE, RowLayout
from shmmap.dividing.sources import Bound3, Source
from shmmap.errors import MapDataError
from shmmap.formats.finite import Bounds

__all__ = ["FLOAT32_REACH_M", "Frame", "Translation", "choose_frame", "frame_between"]

FLOAT32_REACH_M: Final = 16384.0
"""Below, rounding to float32 moves a coordinate by less than half a millimetre."""

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
        Added to each point of the inputs, metres.
    axis
        Type of x, y and z: float32 or float64.
    notes
        What a person should know about it.
    reach_m
        Coordinates beyond lose precision that the inputs have.
    """

    move: tuple[float, float, float]
    axis: np.dtype[np.floating]
    notes: tuple[str, ...] = ()
    reach_m: float = math.inf

    @property
    def origin(self) -> tuple[float, float, float]:
        """Where the origin of the map's frame lies in that of the inputs, metres."""
        x, y, z = (0.0 - part for part in self.move)
        return x, y, z

    def check(self, extremes: Extremes) -> None:
        """Refuse points (2, 3: least, greatest) that lie elsewhere than their files' headers said.

        Raises
        ------
        MapDataError
            float32 lost more of them than was planned.
        """
        reach = float(np.abs(extremes).max())
        if self.axis.itemsize == 4 and math.isfinite(reach) and reach > self.reach_m * _ROUNDING:
            raise MapDataError(
                f"points lie up to {reach:.0f} m from the map's origin, beyond what the headers say",
                cause="bad_bounds",
                hint="give --translate X,Y,Z or none",
            )


def _source_bounds(sources: Sequence[Source]) -> Bound3:
    """Bounds of the finite points of all sources: from their headers where they say, else by reading them.

    NaN when there is no finite point.
    """
    bounds = Bounds()
    for source in sources:
        if source.claimed_bounds is not None:
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
    """Choose the frame of a map made of ``sources``, whose common rows are ``row``.

    Parameters
    ----------
    translation
        Numbers to add to x, y and z; ``none`` to keep the frame; ``auto`` to move it where the
        inputs are float64 and float32 would lose more than half a millimetre.  An automatic frame
        lies at whole metres and whole cells, so that the cells stay the same squares of ground.
    before
        With ``auto``, the move to prefer where float32 is precise enough with it.
    """
    if row["x"].itemsize == 4 and not isinstance(translation, tuple):
        return Frame(NO_MOVE, np.dtype(np.float32))
    return frame_between(_source_bounds(sources), row["x"], lattice, translation, before)


def frame_between(
    bounds: Bound3,
    axis: np.dtype[np.floating],
    lattice: CellLattice,
    translation: Translation,
    before: tuple[float, float, float] | None = None,
) -> Frame:
    """Choose as `choose_frame` does, for points of a type between the least and greatest coordinates."""
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
            # exactly, rounded once: a multiple of a size with decimals keeps as few of them
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


def _loss_mm(reach: float) -> float:
    return float(np.spacing(np.float32(reach))) / 2 * 1e3


def _moved_note(move: Sequence[float], reach: float) -> str:
    x, y, z = move
    return (
        f"moved by ({x:.12g}, {y:.12g}, {z:.12g}) m: float32 would have lost up to {_loss_mm(reach):.2g} mm "
        "where the points were; `shmmap divide --translate none` keeps their frame, in float64"
    )


def _kept_note(reach: float) -> str:
    return (
        f"x, y and z stay float64: float32 would lose up to {_loss_mm(reach):.2g} mm; "
        "Autoware's loader reads float32 only"
    )

# SPDX-License-Identifier: Apache-2.0
"""The lattice of square cells, with corners that are exact decimal numbers.

A cell is half open: ``corner(i) <= x < corner(i + 1)``.  Sizes such as 0.1 m have no exact binary form, and
``floor(x / 0.1)`` and ``3 * 0.1`` disagree with the text 0.3 in a metadata file.  So corners are kept as
integers over a power of ten.  The quotient equals the number parsed from the decimal text, and points are
compared with it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from typing import Final

from shmmap.errors import BadRequest

MAX_DECIMALS: Final = 6  # so that corners up to 4.5e9 m are exact integers in float64
_EXACT: Final = 1 << 53  # beyond, an integer is not exact in float64


@dataclass(frozen=True, slots=True)
class CellLattice:
    """Cells of ``step / scale`` metres, with one corner at ``(origin_x, origin_y) / scale``.

    Attributes
    ----------
    step, origin_x, origin_y
        Integers, in units of ``1 / scale`` metres.
    scale
        A power of ten.
    """

    step: int
    origin_x: int = 0
    origin_y: int = 0
    scale: int = 1

    @classmethod
    def of(cls, cell_size: float, origin: tuple[float, float] = (0.0, 0.0)) -> CellLattice:
        """Return the lattice of cells of ``cell_size`` metres with a corner at ``origin`` (x, y in metres).

        Raises
        ------
        BadRequest
            The size is not positive, or a number has more than 6 decimals or is out of range.
        """
        if not (math.isfinite(cell_size) and cell_size > 0):
            raise BadRequest(f"the cell size must be a positive number of metres, not {cell_size!r}")
        decimals = [_decimal(value) for value in (cell_size, *origin)]
        places = max(max(0, -int(value.as_tuple().exponent)) for value in decimals)
        if places > MAX_DECIMALS:
            raise BadRequest(
                f"cell size, origin and translation may have {MAX_DECIMALS} decimals, not {places}",
                hint="round them, so that the corners are exact decimal numbers",
            )
        step, x, y = (int(value.scaleb(places)) for value in decimals)
        if max(step, abs(x), abs(y)) >= _EXACT:
            raise BadRequest("cell size or origin has too many digits")
        return cls(step, x, y, 10**places)

    @property
    def numbers(self) -> tuple[float, float, float, int, int, int, int]:
        """Numbers of the lattice for `shmmap.dividing.kernels.assign_cells`."""
        return (self.size, *self.origin, self.step, self.origin_x, self.origin_y, self.scale)

    @property
    def size(self) -> float:
        """Side of a cell, metres."""
        return self.step / self.scale

    @property
    def origin(self) -> tuple[float, float]:
        """A corner of the lattice (x, y), metres."""
        return self.origin_x / self.scale, self.origin_y / self.scale

    @property
    def whole(self) -> bool:
        """Whether every corner is a whole number of metres, which Autoware's loader requires."""
        return self.step % self.scale == self.origin_x % self.scale == self.origin_y % self.scale == 0

    def corner(self, ix: int, iy: int) -> tuple[float, float]:
        """Return a cell's lower left corner, metres: the float64 nearest to its exact decimal value."""
        return (self.origin_x + ix * self.step) / self.scale, (self.origin_y + iy * self.step) / self.scale

    def corner_text(self, ix: int, iy: int) -> tuple[str, str]:
        """Return a cell's corner as exact decimal text; an integer if it is whole."""
        return self._text(self.origin_x + ix * self.step), self._text(self.origin_y + iy * self.step)

    def file_name(self, prefix: str, ix: int, iy: int) -> str:
        """Return the name of a cell's file, which contains its corner."""
        x, y = self.corner_text(ix, iy)
        return f"{prefix}_{x}_{y}.pcd"

    @property
    def size_text(self) -> str:
        """The size as exact decimal text."""
        return self._text(self.step)

    def moved(self, x: float, y: float) -> CellLattice:
        """Return the same squares of ground in a frame whose origin is at (x, y) metres in this frame."""
        shift = CellLattice.of(1.0, (x, y))
        scale = max(self.scale, shift.scale)
        mine, theirs = scale // self.scale, scale // shift.scale
        return CellLattice(
            self.step * mine,
            self.origin_x * mine - shift.origin_x * theirs,
            self.origin_y * mine - shift.origin_y * theirs,
            scale,
        )

    def common_step(self) -> Fraction:
        """Smallest whole number of metres divisible by the cell size; if above 10 km, the cell size."""
        cell = Fraction(self.step, self.scale)
        whole = cell.numerator  # cell * denominator
        return Fraction(whole) if whole < 10_000 else cell

    def _text(self, units: int) -> str:
        whole, rest = divmod(abs(units), self.scale)
        sign = "-" if units < 0 else ""
        if not rest:
            return f"{sign}{whole}"
        places = len(str(self.scale)) - 1
        return f"{sign}{whole}.{rest:0{places}d}".rstrip("0")


def _decimal(value: float) -> Decimal:
    if not math.isfinite(value):
        raise BadRequest(f"{value!r} is not a number of metres")
    return Decimal(repr(float(value))).normalize()

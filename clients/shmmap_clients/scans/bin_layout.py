# SPDX-License-Identifier: Apache-2.0
"""Layout of a ``.bin`` scan: rows of bare numbers, with columns named by the user or guessed from values.

KITTI writes four float32 a point (x y z intensity), nuScenes five (and ring), others three or six, or
doubles; the file does not contain its layout.  A layout is accepted only if coordinates and intensity are
plausible, and if rows of its length explain the numbers best: the distribution of numbers differs between
columns, so the right length is the one whose columns can be coded with the fewest bits.
"""

from __future__ import annotations

import math
import os
import re
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest, MapDataError

OPTION_HINT: Final = (
    "name the columns, such as --bin-columns x,y,z,intensity,ring; doubles: x:f8,y,z,intensity"
)

_TYPE: Final = re.compile(r"[<>]?(f4|f8|[iu][1248])")
_LENGTHS: Final = (4, 3, 5, 6)
"""Recognised numbers of values a row; the earlier one wins a tie."""
_LONGER: Final = (7, 8)  # refused if they explain the numbers better
_NAMES: Final = ("x", "y", "z", "intensity")
_FARTHEST_M: Final = 1e7  # the largest northing; scans may be in a map's frame
_NEAREST_M: Final = 1e-6  # smaller numbers, except zero, are halves of doubles
_LARGEST_INTENSITY: Final = 65535.0
_BAD_SHARE: Final = 0.02  # allowed share of implausible numbers: some scanners mark lost returns
_SAMPLE_BYTES: Final = 1 << 20
_FEW: Final = 840  # numbers, a multiple of all lengths; fewer do not determine the length
_BITS_FOR_MULTIPLE: Final = 0.5
"""Bits a number that a multiple of a length must save; scanners that fire lasers in turn also save some."""
_BITS_FOR_OTHER: Final = 0.1


@dataclass(frozen=True, slots=True)
class BinLayout:
    """The columns of a row.

    Attributes
    ----------
    columns
        Name and numpy type of each, such as ``("x", "<f4")``; columns named ``_`` are left out.
    """

    columns: tuple[tuple[str, str], ...]

    @classmethod
    def parse(cls, text: str) -> BinLayout:
        """Parse ``x,y,z,intensity``: names separated by commas, float32 by default.

        In ``x:f8,y,z,t:u4``, a type also applies to the columns after it; ``_`` skips a column.

        Raises
        ------
        BadRequest
            A type is unknown, a name is repeated, or x, y or z is missing.
        """
        kind, columns = "f4", []
        for word in text.split(","):
            name, colon, named = (part.strip() for part in word.partition(":"))
            if colon:
                kind = named.lower()
            if not name or not _TYPE.fullmatch(kind):
                raise BadRequest(
                    f"{word.strip()!r} is no column of a .bin",
                    hint="NAME or NAME:TYPE, with a type of f4, f8, i1 to i8, u1 to u8",
                )
            columns.append((name, np.dtype(kind if kind[0] in "<>" else f"<{kind}").str))
        names = [name for name, _ in columns if name != "_"]
        if len(names) != len({*names}) or not {"x", "y", "z"} <= {*names} or "xyz" in names:
            raise BadRequest(
                f"columns {text}: x, y and z must be among them, and no name twice", hint=OPTION_HINT
            )
        return cls(tuple(columns))

    @property
    def row_bytes(self) -> int:
        """Bytes of a point."""
        return sum(np.dtype(kind).itemsize for _, kind in self.columns)

    def __str__(self) -> str:
        kinds = {np.dtype(kind).name for _, kind in self.columns}
        names = " ".join(name for name, _ in self.columns)
        return f"rows of {len(self.columns)} {kinds.pop() if len(kinds) == 1 else 'numbers'}, {names}"

    def read(self, name: str) -> dict[str, NDArray[Any]]:
        """Read a file: ``xyz`` (N, 3) float32, or float64 as in the file, and the other columns.

        Raises
        ------
        MapDataError
            The size is not a multiple of a row, or x, y and z are implausible as coordinates.
        OSError
            The file cannot be read.
        """
        size = os.path.getsize(name)
        if size % self.row_bytes:
            raise MapDataError(
                f"{name}: {size} bytes are not a multiple of {self.row_bytes}: no {self}",
                hint=OPTION_HINT,
            )
        fields = [(f"{number}", kind) for number, (_, kind) in enumerate(self.columns)]
        rows = np.fromfile(name, np.dtype(fields))
        columns = {
            column: rows[field]
            for (column, _), (field, _) in zip(self.columns, fields, strict=True)
            if column != "_"
        }
        parts = [columns.pop(axis) for axis in "xyz"]
        double = any(part.dtype.kind != "f" or part.dtype.itemsize > 4 for part in parts)
        xyz = np.stack(parts, axis=1).astype(np.float64 if double else np.float32, copy=False)
        if wrong := _no_coordinates(xyz):
            raise MapDataError(f"{name}: read as {self}: {wrong}", hint=OPTION_HINT)
        native = {key: values.astype(values.dtype.newbyteorder("=")) for key, values in columns.items()}
        return {"xyz": xyz, **native}


def guess_layout(name: str) -> BinLayout | None:
    """Guess the columns of a file from its numbers; None for an empty file.

    Raises
    ------
    MapDataError
        The numbers fit no known layout.
    OSError
        The file cannot be read.
    """
    size = os.path.getsize(name)
    if not size:
        return None
    with open(name, "rb") as file:
        sample = file.read(_SAMPLE_BYTES)
    reasons: list[str] = []
    if not size % 4:
        floats = np.frombuffer(sample[: len(sample) // 8 * 8 or 4], "<f4")
        words = floats.view("<u4")  # the lower halves of doubles with few digits are zero
        halves = len(words) > 1 and not words[::2].any() and bool(words[1::2].any())
        if not halves:
            found = _lengths(floats, size, 4, reasons)
            if name.lower().endswith(".pcd.bin") and 5 in found:
                return _layout(floats, 5)
            if length := _best(name, floats, found):
                return _layout(floats, length)
    if not size % 8:
        doubles = np.frombuffer(sample[: len(sample) // 8 * 8], "<f8")
        if length := _best(name, doubles, _lengths(doubles, size, 8, reasons)):
            return _layout(doubles, length)
    if not reasons:
        reasons.append(f"its size, {size} bytes, is no number of rows of 3 to 6 float32 or float64")
    raise MapDataError(f"{name}: not recognised as points: {reasons[0]}", hint=OPTION_HINT)


def _layout(values: NDArray[Any], length: int) -> BinLayout:
    """Return the names of columns for a number of values a row."""
    rows = values[: len(values) // length * length].reshape(-1, length)
    names = [*_NAMES][:length]
    for number in range(len(names), length):
        column = rows[:, number]
        ring = "ring" not in names and bool((column == np.clip(np.rint(column), 0, 255)).all())
        other = "time" if "time" not in names else f"column_{number + 1}"
        names.append("ring" if ring else other)
    return BinLayout(tuple((name, values.dtype.str) for name in names))


def _lengths(values: NDArray[Any], size: int, each: int, reasons: list[str]) -> list[int]:
    """Return the lengths of rows with plausible columns; append to ``reasons`` why others are not."""
    found = []
    for length in _LENGTHS:
        if size % (length * each):
            continue
        rows = values[: len(values) // length * length].reshape(-1, length)
        wrong = _no_coordinates(rows[:, :3]) or (_no_intensity(rows[:, 3]) if length > 3 else "")
        if wrong:
            reasons.append(f"as rows of {length} {values.dtype.name}, {wrong}")
        else:
            found.append(length)
    return found


def _best(name: str, values: NDArray[Any], lengths: list[int]) -> int:
    """Return the plausible length that explains the numbers best; 0 if there is none.

    Raises
    ------
    MapDataError
        An implausible length explains the numbers better.
    """
    if not lengths or len(values) < 2 * _FEW:
        return lengths[0] if lengths else 0
    bits = {length: _bits(values, length) for length in (*_LENGTHS, *_LONGER)}

    def better(one: int, other: int) -> bool:
        return bits[one] < bits[other] - (_BITS_FOR_MULTIPLE if not one % other else 0.0)

    best = lengths[0]
    for length in sorted(lengths):
        best = length if better(length, best) or (not best % length and not better(best, length)) else best
    for length in (*_LENGTHS, *_LONGER):
        margin = 0.0 if not length % best else _BITS_FOR_OTHER
        if length not in lengths and better(length, best) and bits[length] < bits[best] - margin:
            raise MapDataError(
                f"{name}: not recognised as points: its rows seem to have {length} numbers"
                f" ({values.dtype.name}), but not x y z and an intensity first",
                hint=OPTION_HINT,
            )
    return best


def _bits(values: NDArray[Any], length: int) -> float:
    """Return the bits that a number's sign and exponent take, if each column has its own code.

    This is the evidence of one categorical distribution a column with Jeffreys' prior (Krichevsky and
    Trofimov 1981): each additional column costs the bits to learn its code.
    """
    used = values[: len(values) // _FEW * _FEW]
    shift, word = (23, "<u4") if used.dtype.itemsize == 4 else (52, "<u8")
    _, symbols = np.unique(used.view(word) >> np.uint64(shift).astype(word), return_inverse=True)
    kinds = int(symbols.max()) + 1
    total = 0.0
    for column in symbols.reshape(-1, length).T:
        counts = np.bincount(column)
        total += math.lgamma(kinds / 2) - math.lgamma(len(column) + kinds / 2)
        total += sum(math.lgamma(count + 0.5) - math.lgamma(0.5) for count in counts[counts > 0].tolist())
    return -total / math.log(2) / len(used)


def _no_coordinates(xyz: NDArray[Any]) -> str:
    """Return why numbers cannot be coordinates in metres, or an empty text if they can."""
    for axis, values in zip("xyz", xyz.T, strict=True):
        size = np.abs(values[np.isfinite(values)])
        good = (size == 0) | ((size >= _NEAREST_M) & (size <= _FARTHEST_M))
        if _too_many(~good):
            return f"{axis} would be {float(size[~good][0]):.3g} m"
    return ""


def _no_intensity(values: NDArray[Any]) -> str:
    """Return why numbers cannot be intensities, or an empty text if they can."""
    finite = values[np.isfinite(values)]
    good = (finite >= 0) & (finite <= _LARGEST_INTENSITY)
    if not _too_many(~good):
        return ""
    low, high = float(finite.min()), float(finite.max())
    return f"the 4th number of a row would be {low:.3g} to {high:.3g}, no intensity"


def _too_many(bad: NDArray[np.bool_]) -> bool:
    """Return whether more numbers are implausible than marks of lost returns explain."""
    return int(np.count_nonzero(bad)) > max(1, int(_BAD_SHARE * len(bad)))

# SPDX-License-Identifier: Apache-2.0
"""Notes that follow from a file's points: marked as not to be used, or not what they are taken for.

A reader has one `PointChecks`; what reads its points adds them, so that a run that is resumed counts each
point once.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

FLOAT32_REACH_M: Final = 16384.0
"""Below this, rounding to float32 moves a coordinate by less than half a millimetre."""

Columns = Mapping[str, NDArray[Any]]


class PointChecks:
    """Numbers found in the points so far; here none.

    Attributes
    ----------
    counts
        The numbers by name, which JSON can hold.
    """

    def __init__(self) -> None:
        self.counts: dict[str, float] = {}

    def add(self, columns: Columns) -> None:
        """Add points: ``xyz`` (N, 3) and the other columns of the file."""

    def notes(self) -> tuple[str, ...]:
        """Return what the user should know about the points so far."""
        return ()

    def _count(self, name: str, number: int) -> None:
        if number:
            self.counts[name] = self.counts.get(name, 0) + number


# --- LAS ------------------------------------------------------------------------------------------------

_NOISE: Final = (7, 18)  # low and high noise


def _noise(columns: Columns) -> NDArray[np.bool_]:
    classes = columns["classification"]
    mask: NDArray[np.bool_] = (classes == _NOISE[0]) | (classes == _NOISE[1])
    return mask


def las_left_out(columns: Columns, *, drop_noise: bool) -> NDArray[np.bool_]:
    """Return (N,) which points are left out: those flagged withheld, and with ``drop_noise`` noise."""
    mask: NDArray[np.bool_] = columns["withheld"] != 0
    return mask | _noise(columns) if drop_noise else mask


class LasChecks(PointChecks):
    """Counts of points of LAS that are withheld, noise, or synthetic."""

    def __init__(self, *, drop_noise: bool) -> None:
        super().__init__()
        self._drop_noise = drop_noise

    def add(self, columns: Columns) -> None:
        """Add points, with the dimensions of LAS."""
        withheld = columns["withheld"] != 0
        self._count("withheld", int(np.count_nonzero(withheld)))
        self._count("noise", int(np.count_nonzero(_noise(columns) & ~withheld)))
        self._count("synthetic", int(np.count_nonzero((columns["synthetic"] != 0) & ~withheld)))

    def notes(self) -> tuple[str, ...]:
        """Return what was left out, and what else is marked."""
        withheld, noise, synthetic = (
            int(self.counts.get(name, 0)) for name in ("withheld", "noise", "synthetic")
        )
        notes = []
        if withheld:
            notes.append(f"{withheld:,} points left out: flagged withheld, which is not to be processed")
        if noise and self._drop_noise:
            notes.append(f"{noise:,} points left out: classified as noise (classes 7 and 18)")
        elif noise:
            notes.append(
                f"{noise:,} points are classified as noise (classes 7 and 18) and kept: --drop-noise of"
                " divide, serve, prepare and publish leaves them out"
            )
        if synthetic:
            notes.append(f"{synthetic:,} points are flagged synthetic, which is not measured, and kept")
        return tuple(notes)


# --- text -----------------------------------------------------------------------------------------------

_STEPS: Final = (100_000.0, 10_000.0, 1000.0, 100.0, 10.0, 1.0, 0.5)
_NO_HEIGHT: Final = (-9999.0, -99999.0, -32768.0)
_MANY: Final = 100  # points; fewer may lie on a lattice by chance


class TextChecks(PointChecks):
    """Extents of coordinates whose columns are guessed, rows of zeros, heights that are none, and rounding.

    ``unit_m`` are metres per unit of x and y, and of z.
    """

    def __init__(self, *, guessed: bool, unit_m: tuple[float, float] = (1.0, 1.0)) -> None:
        super().__init__()
        self._guessed = guessed
        self._unit_m = unit_m

    def add(self, columns: Columns) -> None:
        """Add points."""
        xyz = columns["xyz"]
        finite = xyz[np.isfinite(xyz).all(axis=1)]
        if not len(finite):
            return
        self._count("points", len(finite))
        self._count("zeros", int(np.count_nonzero(~finite.any(axis=1))))
        self._count("no_height", int(np.count_nonzero(np.isin(finite[:, 2], _NO_HEIGHT))))
        counts = self.counts
        for axis, values in zip("xyz", finite.T, strict=True):
            counts[f"low_{axis}"] = min(counts.get(f"low_{axis}", math.inf), float(values.min()))
            counts[f"high_{axis}"] = max(counts.get(f"high_{axis}", -math.inf), float(values.max()))
            step = int(counts.get(f"step_{axis}", 0))
            while step < len(_STEPS) and np.any(values % _STEPS[step]):
                step += 1
            counts[f"step_{axis}"] = step

    def notes(self) -> tuple[str, ...]:
        """Return what is odd about the coordinates."""
        counts, notes = self.counts, []
        points, zeros = int(counts.get("points", 0)), int(counts.get("zeros", 0))
        if zeros > 1:
            notes.append(
                f"{zeros:,} points are at exactly (0, 0, 0), as scanners write what they did not see"
            )
        if no_height := int(counts.get("no_height", 0)):
            values = " or ".join(f"{value:g}" for value in _NO_HEIGHT)
            notes.append(f"{no_height:,} points have a z of {values}, as tables write what is not known")
        if points > 1 and self._guessed:
            flat = [axis for axis in "xyz" if counts[f"low_{axis}"] == counts[f"high_{axis}"]]
            if flat:
                values = ", ".join(f"{counts[f'low_{axis}']:g}" for axis in flat)
                notes.append(
                    f"all points have the same {', '.join(flat)} ({values}): if other columns are the"
                    f" coordinates, {NAME_THEM}"
                )
        rounded = []
        for axis in "xyz" if points >= _MANY else "":
            step, low, high = (counts[f"{name}_{axis}"] for name in ("step", "low", "high"))
            unit_m = self._unit_m[axis == "z"]
            if (
                step < len(_STEPS)
                and low < high
                and _STEPS[int(step)] * unit_m >= _STEPS[-1]
                and max(-low, high) * unit_m >= FLOAT32_REACH_M
            ):
                rounded.append(f"all {axis} are multiples of {_STEPS[int(step)]:g}")
        if rounded:
            notes.append(f"{', '.join(rounded)}: rounded when the file was written?")
        return tuple(notes)


NAME_THEM: Final = "name all columns in a first line, such as 'id x y z' or 'r g b x y z'"


def step_warning(
    low: NDArray[np.float64], high: NDArray[np.float64], axis: np.dtype[Any], unit_m: float = 1.0
) -> str:
    """Return a warning if coordinates in float32 (bounds (3,) each) are far from zero, else an empty text."""
    reach = float(max(np.abs(low).max(), np.abs(high).max()))
    if axis.itemsize != 4 or not math.isfinite(reach) or reach * unit_m < FLOAT32_REACH_M:
        return ""
    exponent = math.frexp(float(np.float32(reach)))[1]
    step = np.format_float_positional(math.ldexp(1.0, exponent - 24), trim="-")
    return (
        f"x, y and z are float32 and so far from zero that they are multiples of {step}: what is finer was"
        " lost before; write them as float64, or nearer to zero"
    )

# SPDX-License-Identifier: Apache-2.0
"""Points on a lattice of millimetres, in the order of a space-filling curve: half the bytes of exact ones.

A coordinate is ``origin + 0.001 * count``, in binary64, rounded once to binary32: at most half a millimetre
and half a step of binary32 from what it was.  Rows are in Morton order of their counts: what is near in the
file is near in space, and the bytes of a plane are alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["MillimetrePoints", "from_millimetres", "to_millimetres"]

STEP_M: Final = 0.001
MAX_COUNT: Final = 0xFFFF


@dataclass(frozen=True, slots=True, eq=False)
class MillimetrePoints:
    """Points of one cell.

    Attributes
    ----------
    origin
        (3,) float64, metres, in the frame of the points.
    counts
        (N, 3) uint16, in Morton order.
    order
        (N,) int64: the row that each of these was.
    """

    origin: NDArray[np.float64]
    counts: NDArray[np.uint16]
    order: NDArray[np.int64]

    @property
    def xyz(self) -> NDArray[np.float32]:
        """(N, 3) float32, metres: what a reader makes of them."""
        return from_millimetres(self.counts, self.origin)


def to_millimetres(xyz: NDArray[Any]) -> MillimetrePoints | None:
    """Round points to millimetres.

    Parameters
    ----------
    xyz
        (N, 3) metres.

    Returns
    -------
    None where they have to stay as they are: they are no float32, none, not all finite, or more than 65.535 m
    apart along an axis.
    """
    if xyz.dtype != np.float32 or xyz.ndim != 2 or xyz.shape[1] != 3 or not len(xyz):
        return None
    axes = np.ascontiguousarray(xyz.T).astype(np.float64)
    low, high = axes.min(axis=1), axes.max(axis=1)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        return None
    origin = np.floor(low * 1000.0) / 1000.0
    axes -= origin[:, None]
    axes *= 1000.0
    np.rint(axes, out=axes)
    if axes.max() > MAX_COUNT:
        return None
    numbers = np.maximum(axes, 0.0, out=axes).astype(np.uint16)
    key = np.zeros(len(xyz), np.uint64)
    for axis, spread in zip(numbers, _spread(), strict=True):
        key |= spread[axis]
    order = np.argsort(key, kind="stable")
    return MillimetrePoints(origin, np.ascontiguousarray(numbers[:, order].T), order)


def from_millimetres(counts: NDArray[np.uint16], origin: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return (N, 3) float32 metres of (N, 3) counts of millimetres from an origin (3,)."""
    xyz = np.empty(counts.shape, np.float32)
    for axis in range(3):
        xyz[:, axis] = counts[:, axis] * STEP_M + origin[axis]
    return xyz


@cache
def _spread() -> tuple[NDArray[np.uint64], ...]:
    """For each axis, the bits of each number of 16 bits where the key has them: every third bit."""
    spread = np.arange(MAX_COUNT + 1, dtype=np.uint64)
    for shift, mask in ((16, 0x0000FF0000FF), (8, 0x00F00F00F00F), (4, 0x0C30C30C30C3), (2, 0x249249249249)):
        spread = (spread | spread << np.uint64(shift)) & np.uint64(mask)
    return tuple(spread << np.uint64(axis) for axis in range(3))

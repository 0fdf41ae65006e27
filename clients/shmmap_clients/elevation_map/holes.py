# SPDX-License-Identifier: Apache-2.0
"""Fills holes of a grid from the heights around them, in floating point.

A hole that has a known height within the radius gets the value, at its middle, of the plane that fits the
known heights within the radius and two columns more best, weighted by 1 / distance²; so a slope goes
on through a hole.  Where those lie on one line, or are fewer
than three, it is their weighted mean.  Upstream inpaints an 8-bit image of the whole map, where 100 m of
relief make steps of 0.39 m.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["fill_holes", "fill_reach"]

_FIT_MORE = 2.0  # columns: behind the rim of a hole, so that there is a plane and not a line
_FLAT = 1e-6  # relative determinant below which a plane is not determined


def fill_reach(radius: float) -> int:
    """How many columns away heights are looked at when filling within ``radius`` columns."""
    return int(radius + _FIT_MORE) if radius >= 1 else 0


def fill_holes(heights: NDArray[np.float32], radius: float) -> NDArray[np.float32]:
    """Return the heights with holes filled as far as known heights reach.

    A result depends on known heights within `fill_reach` alone: blocks with that much margin give the
    same as the whole.

    Parameters
    ----------
    heights
        (rows, columns) float32, metres; NaN in holes.
    radius
        Columns.
    """
    reach = fill_reach(radius)
    if not reach or not heights.size:
        return heights
    padded = np.pad(heights, reach, constant_values=np.nan)
    rows, columns = np.nonzero(np.isnan(heights) & _near_known(padded, reach, int(radius)))
    if not len(rows):
        return heights
    # sums of weight times 1, x, y, xx, xy, yy, z, xz, yz; z about the first neighbour, for its digits
    sums = np.zeros((9, len(rows)))
    about = np.full(len(rows), np.nan)
    some = np.zeros(len(rows), np.bool_)
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            squared = dx * dx + dy * dy
            if not 0 < squared <= (radius + _FIT_MORE) ** 2:
                continue
            z = padded[rows + reach + dy, columns + reach + dx].astype(np.float64)
            known = ~np.isnan(z)
            if squared <= radius * radius:
                some |= known
            about = np.where(np.isnan(about), z, about)
            weight = np.where(known, 1.0 / squared, 0.0)
            away = np.where(known, z - about, 0.0)
            for n, factor in enumerate((1.0, dx, dy, dx * dx, dx * dy, dy * dy)):
                sums[n] += weight * factor
            for n, factor in enumerate((1.0, dx, dy)):
                sums[6 + n] += weight * away * factor
    s, sx, sy, sxx, sxy, syy, sz, sxz, syz = sums
    with np.errstate(divide="ignore", invalid="ignore"):
        # normal equations of z = a + b x + c y, by Cramer's rule for a alone
        minor_x, minor_y, minor = sxx * syy - sxy * sxy, sx * syy - sy * sxy, sx * sxy - sy * sxx
        determinant = s * minor_x - sx * minor_y + sy * minor
        plane = (sz * minor_x - sxz * minor_y + syz * minor) / determinant
        good = determinant > _FLAT * s * sxx * syy
        value = about + np.where(good & (sxx > 0) & (syy > 0), plane, sz / s)
    result = heights.copy()
    result[rows[some], columns[some]] = value[some].astype(np.float32)
    return np.asarray(result)


def _near_known(padded: NDArray[np.float32], margin: int, reach: int) -> NDArray[np.bool_]:
    """Which places have a known height in the square of half-side ``reach``, by sums over rectangles.

    ``padded`` has ``margin`` more rows and columns on each side than the result.
    """
    side = 2 * reach + 1
    more = margin - reach
    padded = padded[more : len(padded) - more, more : padded.shape[1] - more]
    total = np.zeros((padded.shape[0] + 1, padded.shape[1] + 1), np.int32)
    np.cumsum(~np.isnan(padded), axis=0, dtype=np.int32, out=total[1:, 1:])
    np.cumsum(total, axis=1, out=total)
    inside = total[side:, side:] - total[:-side, side:] - total[side:, :-side] + total[:-side, :-side]
    return np.asarray(inside > 0)

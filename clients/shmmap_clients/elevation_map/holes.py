# SPDX-License-Identifier: Apache-2.0
"""Fills holes of a grid from the heights around them, in floating point.

A column without a height is filled if there is a known height within the radius, and at least three within
the radius plus two columns.  Its value is that of the best plane through these heights, weighted by
1 / distance², at the column's centre, so that a slope continues through a hole.  If these heights lie on one
line, the value is their weighted mean.  Upstream inpaints an 8-bit image of the whole map, where 100 m of
relief have steps of 0.39 m.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numba import types
from numpy.typing import NDArray

from shmmap import BadRequest
from shmmap.compiling import compiled, read_only

_FIT_MORE: Final = 2.0  # columns behind the rim of a hole, which make the heights a plane instead of a line
_FARTHEST: Final = 100.0  # columns; time grows with the square
_LEAST: Final = 3  # heights: fewer do not represent their surroundings
_FLAT: Final = 1e-6  # relative determinant below which a plane is not determined


def fill_reach(radius: float) -> int:
    """Return the distance, in columns, of the heights that filling within ``radius`` columns uses.

    Raises
    ------
    BadRequest
        The radius is negative, or so large that filling would take too long.
    """
    if not 0 <= radius <= _FARTHEST:
        raise BadRequest(f"holes are filled within 0 to {_FARTHEST:g} columns, not {radius:g}")
    return int(radius + _FIT_MORE) if radius >= 1 else 0


def fill_holes(heights: NDArray[np.float32], radius: float) -> NDArray[np.float32]:
    """Return the heights with holes filled where known heights are near.

    A filled height depends only on known heights within `fill_reach`, so that blocks with this margin give
    the same result as the whole grid.

    Parameters
    ----------
    heights
        (rows, columns) float32, metres; NaN in holes.
    radius
        Radius in columns.
    """
    if not fill_reach(radius) or not heights.size:
        return heights
    result = np.array(heights, np.float32, order="C")
    _fill(np.ascontiguousarray(heights), radius, fill_reach(radius), result)
    return result


@compiled(
    types.void(read_only(types.float32, 2), types.float64, types.int64, types.float32[:, ::1]),
)
def _fill(heights: Any, radius: Any, reach: Any, result: Any) -> None:
    rows, columns = heights.shape
    near_squared, far_squared = radius * radius, (radius + _FIT_MORE) ** 2
    near = int(radius)
    for row in range(rows):
        for column in range(columns):
            if not np.isnan(heights[row, column]):
                continue
            some = False
            for y in range(max(0, row - near), min(rows, row + near + 1)):
                for x in range(max(0, column - near), min(columns, column + near + 1)):
                    squared = (x - column) ** 2 + (y - row) ** 2
                    if squared <= near_squared and not np.isnan(heights[y, x]):
                        some = True
                        break
                if some:
                    break
            if not some:
                continue
            s, sx, sy, sxx, sxy, syy, sz, sxz, syz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            known = 0
            about = np.nan  # sums are relative to the first neighbour, for precision
            for y in range(max(0, row - reach), min(rows, row + reach + 1)):
                for x in range(max(0, column - reach), min(columns, column + reach + 1)):
                    d_x, d_y = np.float64(x - column), np.float64(y - row)
                    squared = d_x * d_x + d_y * d_y
                    z = np.float64(heights[y, x])
                    if squared > far_squared or np.isnan(z):
                        continue
                    if np.isnan(about):
                        about = z
                    known += 1
                    weight = 1.0 / squared
                    z -= about
                    s += weight
                    sx += weight * d_x
                    sy += weight * d_y
                    sxx += weight * d_x * d_x
                    sxy += weight * d_x * d_y
                    syy += weight * d_y * d_y
                    sz += weight * z
                    sxz += weight * z * d_x
                    syz += weight * z * d_y
            if known < _LEAST:
                continue
            # normal equations of z = a + b x + c y, by Cramer's rule for a alone
            minor_x, minor_y, minor = sxx * syy - sxy * sxy, sx * syy - sy * sxy, sx * sxy - sy * sxx
            determinant = s * minor_x - sx * minor_y + sy * minor
            if determinant > _FLAT * s * sxx * syy:
                value = (sz * minor_x - sxz * minor_y + syz * minor) / determinant
            else:
                value = sz / s
            result[row, column] = np.float32(about + value)

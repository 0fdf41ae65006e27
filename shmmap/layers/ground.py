# SPDX-License-Identifier: Apache-2.0
"""The ``ground`` layer: the lowest point of each column, and the height of the ground at a place.

Maps have points far below the street: reflections in wet asphalt and glass, gullies, pits.  `ground_height`
takes the median of the columns' lowest points within 4 m, which half of those columns would have to mislead.
On a recorded street (154 places, with reflections 4 m below it) it is within 9 cm of the truth everywhere,
and Autoware's rule up to 4.2 m too low.  A height of each column that leaves out single points, as the
``surface`` rule of ``shmmap-elevation`` does, would not have helped: reflections are surfaces, too.

Autoware's height fitter (map_height_fitter) takes the horizontal distance d from (x, y) to the
nearest point, then the lowest z of all points closer than d + 1 m.  ``rule="min"`` asks the same of
columns instead of points, each standing at its middle.  A point is at most half a diagonal from
the middle of its column, so the answer is that of the exact rule with its radius d + 1 m changed by at
most ``resolution * sqrt(2)``: never lower than the lowest point within that much more, never higher
than the lowest within that much less.  The exact rule stays available from ``points``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from shmmap.errors import BadRequest
from shmmap.layers.contract import (
    Lattice,
    LayerColumn,
    LayerKind,
    LayerTable,
    Parameter,
    Parameters,
    PointTable,
)  # fmt: skip
from shmmap.layers.elevation import build_elevation

__all__ = ["KIND", "GroundRule", "build_ground", "ground_height"]

GroundRule = Literal["median", "min"]

# how much farther than the nearest column others count, metres; that of min is the height fitter's
_MARGIN_M: Final[dict[GroundRule, float]] = {"median": 4.0, "min": 1.0}


def build_ground(points: PointTable, parameters: Parameters) -> LayerTable:
    """Lowest z of each column.

    Raises
    ------
    MapDataError
        If the grid cannot hold the coordinates.
    """
    table = build_elevation(points, parameters)
    return LayerTable({"min": table["min"]}, table.rows, {"min": "m"}, table.lattice)


def ground_height(
    grids: Iterable[tuple[NDArray[np.float32], Lattice]],
    x: float,
    y: float,
    *,
    rule: GroundRule = "median",
    reach_m: float = 50.0,
    margin_m: float | None = None,
) -> float | None:
    """Height of the ground at a place.

    Parameters
    ----------
    grids
        ``min`` (ny, nx) and lattice of the ``ground`` (or ``elevation``) layers around the place.
    x, y
        Metres, map frame.
    rule
        ``median``: of the columns near by, the upper one of an even number.  ``min``: the lowest of them, as
        Autoware's height fitter answers.
    reach_m
        How far away the nearest column may be (the fitter asks for points within 50 m).
    margin_m
        How much farther than the nearest one columns count; None: 4 m for ``median``, 1 m for ``min``.

    Returns
    -------
    z, metres, map frame; None where there is nothing within reach, or x or y is not finite.

    Raises
    ------
    BadRequest
        There is no such rule.
    """
    if rule not in _MARGIN_M:
        raise BadRequest(f"unknown rule of the ground {rule!r}", hint=f"rules are: {', '.join(_MARGIN_M)}")
    if not (math.isfinite(x) and math.isfinite(y)):
        return None
    margin = _MARGIN_M[rule] if margin_m is None else margin_m
    parts = [_window(low, lattice, x, y, reach_m + margin) for low, lattice in grids]
    near = [part for part in parts if part is not None]
    if not near:
        return None
    distance, low = (np.concatenate(column) for column in zip(*near, strict=True))
    least = float(distance.min())
    if least > reach_m:
        return None
    # a margin of zero leaves the nearest column
    counted = np.sort(low[(distance < least + margin) | (distance == least)])
    return float(counted[0 if rule == "min" else len(counted) // 2])


def _window(
    low: NDArray[np.float32], lattice: Lattice, x: float, y: float, radius: float
) -> tuple[NDArray[np.float64], NDArray[np.float32]] | None:
    """Distance and height of the occupied columns whose middles are near; None without any."""
    edge = lattice.leaf[0]
    i, j = lattice.first[0], lattice.first[1]
    at_x = (np.arange(i, i + low.shape[1]) + 0.5) * edge - x
    at_y = (np.arange(j, j + low.shape[0]) + 0.5) * edge - y
    columns, rows = np.flatnonzero(np.abs(at_x) <= radius), np.flatnonzero(np.abs(at_y) <= radius)
    if not (len(columns) and len(rows)):
        return None
    inner = low[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    occupied = ~np.isnan(inner)
    if not occupied.any():
        return None
    distance = np.hypot(at_x[columns][None, :], at_y[rows][:, None])
    return distance[occupied], inner[occupied]


KIND: Final = LayerKind(
    name="ground",
    builder_version=1,
    summary="lowest height of each column of a ground grid, for fitting a pose's height",
    borders="as elevation: the lower of both cells' columns is that of the whole",
    parameters=(
        Parameter("resolution", float, "edge of a column", "m", default=0.5, above=0.0, maximum=1e6),
    ),
    columns=(LayerColumn("min", np.dtype("<f4"), "(ny, nx)", "m", "lowest z, map frame; NaN: no points"),),
    build=build_ground,
    bytes_ratio=0.05,
)

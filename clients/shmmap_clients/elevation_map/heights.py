# SPDX-License-Identifier: Apache-2.0
"""Definition of a column's height, and heights around a moving vehicle, from the layers of its window."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest, MapWindow
from shmmap.layers import canonical_layer

RULES: Final = ("surface", "min", "mean", "max")
_FARTHEST: Final = 1 << 40  # columns; beyond every layer


@dataclass(frozen=True, slots=True)
class ElevationRule:
    """Rule for the height of a column from its points.

    ``surface`` is the rule of grid_map_pcl in Autoware's elevation_map_loader (``height_type`` 1).  Points
    of a column form clusters, in which neighbouring points are at most ``tolerance`` apart.  Candidates are
    clusters of at least ``min_points`` whose mean height is at most ``height_range`` above the lowest such
    mean.  The height is the mean of the candidate with the most points (on a tie, the lowest).  This rule
    requires points.  Its error on a slope, as the points' centre differs from the column's, is about
    0.3 · resolution · slope / sqrt(n) for n points.  ``min``, ``mean`` and ``max`` are over all points of the
    column, and are in the ``elevation`` layer.

    Attributes
    ----------
    name
        ``surface``, ``min``, ``mean`` or ``max``.
    resolution
        Edge of a column, metres; column (i, j) reaches from i · resolution to (i + 1) · resolution.
    tolerance, height_range
        Limits of the ``surface`` rule, metres.
    min_points
        Least number of points of a column, and of a cluster.

    Raises
    ------
    BadRequest
        A value is invalid.
    """

    name: str = "surface"
    resolution: float = 0.3
    tolerance: float = 0.2
    height_range: float = 1.0
    min_points: int = 3

    def __post_init__(self) -> None:
        if self.name not in RULES:
            raise BadRequest(
                f"elevation rule {self.name!r} is unknown", hint=f"use one of {', '.join(RULES)}"
            )
        for what in ("resolution", "tolerance", "height_range"):
            value: float = getattr(self, what)
            if not (math.isfinite(value) and value > 0):
                raise BadRequest(f"{what} must be positive, not {value!r} m")
        if self.min_points < 1:
            raise BadRequest(f"min_points must be at least 1, not {self.min_points}")

    @property
    def layer(self) -> str:
        """Layer from which the rule computes heights."""
        return "points" if self.name == "surface" else f"elevation(resolution={float(self.resolution)!r})"

    @property
    def document(self) -> dict[str, Any]:
        """The rule as JSON."""
        return asdict(self)


class WindowHeights:
    """Heights from the current cells of a window, without copies.

    ::

        rule = ElevationRule("min", resolution=0.5)
        window = shmmap.MapWindow(radius=100.0, layers=rule.layer)
        window.move_to(x, y, wait=5.0)
        heights = WindowHeights(window, rule).at(xy)

    Parameters
    ----------
    window
        Window of the rule's layer.
    rule
        ``min``, ``mean`` or ``max``.

    Raises
    ------
    BadRequest
        The rule requires points.
    """

    def __init__(self, window: MapWindow, rule: ElevationRule) -> None:
        if rule.name == "surface":
            raise BadRequest(
                "the surface rule cannot be answered from elevation layers", hint="use min, mean or max"
            )
        self._window = window
        self._rule = rule
        self._layer = canonical_layer(rule.layer)

    def at(self, xy: NDArray[Any]) -> NDArray[np.float64]:
        """Return heights at positions (N, 2), metres, map frame: (N,) float64 metres, NaN without a point.

        A column on the border of two cells is computed from both.
        """
        column = np.floor(np.asarray(xy, np.float64) * (1.0 / self._rule.resolution))
        column = np.where(np.abs(column) < _FARTHEST, column, _FARTHEST).astype(np.int64)
        name = self._rule.name
        empty = {"min": np.inf, "max": -np.inf, "mean": 0.0}[name]
        result = np.full(len(column), empty)
        count = np.zeros(len(column), np.int64)
        for cell in self._window.cells:
            lattice = cell.header.lattice
            if cell.layer != self._layer or lattice is None:
                continue
            at = column - np.array(lattice.first[:2])
            inside = np.flatnonzero(((at >= 0) & (at < np.array(lattice.shape[:2]))).all(axis=1))
            i, j = at[inside].T
            points = cell["count"][j, i].astype(np.int64)
            inside, i, j, points = (v[points > 0] for v in (inside, i, j, points))
            values = cell[name][j, i].astype(np.float64)
            if name == "mean":
                result[inside] += values * points
            else:
                result[inside] = (np.minimum if name == "min" else np.maximum)(result[inside], values)
            count[inside] += points
        result[count == 0] = np.nan
        return result / np.maximum(count, 1) if name == "mean" else result

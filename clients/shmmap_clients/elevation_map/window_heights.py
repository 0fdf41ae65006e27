# SPDX-License-Identifier: Apache-2.0
"""Heights around a moving vehicle, straight from the ``elevation`` layers of its window."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest, MapWindow
from shmmap.layers import canonical_layer
from shmmap_clients.elevation_map.rule import ElevationRule

__all__ = ["WindowHeights"]

_FARTHEST: Final = 1 << 40  # columns; no layer has any so far away


class WindowHeights:
    """Answers from the window as it is at each call; nothing is copied or kept.

    ::

        rule = ElevationRule("min", resolution=0.5)
        window = shmmap.MapWindow(radius=100.0, layers=rule.layer)
        window.move_to(x, y, wait=5.0)
        heights = WindowHeights(window, rule).at(xy)

    Parameters
    ----------
    window
        With the rule's layer.
    rule
        ``min``, ``mean`` or ``max``.

    Raises
    ------
    BadRequest
        The rule needs points.
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
        """Heights at places, (N, 2) metres, map frame: (N,) float64 metres, NaN where there is no point.

        A column that a border cuts is answered from both cells together.
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

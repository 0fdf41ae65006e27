# SPDX-License-Identifier: Apache-2.0
"""Cells that a stray point or two have made far from all others.

A grid covers the box around its cells: one point kilometres off would make it a thousand times as large.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["far_cells"]

_APART_M: Final = 1000.0  # cells nearer than about that are in one part of a map
_SHARE: Final = 0.01  # of the map's bytes: a part that has more is no stray point
_FEW_BYTES: Final = 4096
_LARGER: Final = 4.0  # times: where the box does not grow by that much, nothing is left out


def far_cells(boxes: NDArray[np.float64], sizes: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return how far each cell lies from the map, where it is alone and holds next to nothing; else 0.

    Parameters
    ----------
    boxes
        (N, 4) float64: min_x, min_y, max_x, max_y, metres.
    sizes
        (N,) int64: bytes of their sources.

    Returns
    -------
    (N,) float64, metres to the nearest cell of the map; 0 for the map's own cells.
    """
    parts = _parts(boxes)
    held = np.bincount(parts, weights=sizes if sizes.any() else np.ones(len(sizes)))
    few = min(max(_SHARE * held.sum(), _FEW_BYTES), held.max() / 10)
    own = (held > few)[parts]
    far = np.zeros(len(boxes))
    if own.all() or _extent(boxes) < _LARGER * _extent(boxes[own]):
        return far
    for number in np.flatnonzero(~own):
        box = boxes[number]
        gap = np.maximum(np.maximum(boxes[own, :2] - box[2:], box[:2] - boxes[own, 2:]), 0.0)
        far[number] = float(np.hypot(gap[:, 0], gap[:, 1]).min())
    return far


def _extent(boxes: NDArray[np.float64]) -> float:
    """Return the area of the box around boxes, square metres; a line is a metre wide."""
    sides = boxes[:, 2:].max(axis=0) - boxes[:, :2].min(axis=0)
    return float(np.maximum(sides, 1.0).prod())


def _parts(boxes: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the part of the map that each cell is in, counted from 0: squares that touch are one part."""
    edge = max(_APART_M, float((boxes[:, 2:] - boxes[:, :2]).max()))
    squares, member = np.unique(
        np.floor((boxes[:, :2] + boxes[:, 2:]) / (2 * edge)).astype(np.int64), axis=0, return_inverse=True
    )
    number = {(i, j): place for place, (i, j) in enumerate(squares.tolist())}
    part = np.full(len(squares), -1, np.int64)
    count = 0
    for start in range(len(squares)):
        if part[start] >= 0:
            continue
        part[start] = count
        ahead = [start]
        while ahead:
            i, j = squares[ahead.pop()].tolist()
            for near in ((i + di, j + dj) for di in (-1, 0, 1) for dj in (-1, 0, 1)):
                place = number.get(near)
                if place is not None and part[place] < 0:
                    part[place] = count
                    ahead.append(place)
        count += 1
    return part[member.reshape(-1)]

# SPDX-License-Identifier: Apache-2.0
"""Fewer points of a scan: one per cube."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from shmmap.layers import build_layer

__all__ = ["thinned"]


def thinned(points: NDArray[np.floating], edge: float | None) -> NDArray[np.floating]:
    """Return the mean of the points in each cube of ``edge`` metres; the points themselves without an edge.

    Parameters
    ----------
    points : (N, 3)
        Metres.
    edge
        Metres; None: all points.

    Raises
    ------
    BadRequest
        The edge makes no sense.
    """
    if edge is None or not len(points):
        return points
    columns = build_layer(f"voxel(leaf={edge!r})", points).columns
    return np.asarray(columns["xyz"], points.dtype)

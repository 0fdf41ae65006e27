# SPDX-License-Identifier: Apache-2.0
"""When the map explains a point: Autoware's three rules, with the layers that answer them.

The rules are those of autoware_compare_map_segmentation, in float64 and across cell borders:

``voxel``
    A voxel of d x d x d·ratio, the point's own or one of the 26 around it, has a centroid c with
    \\|c - p\\| < d along x, < d along y and < d·ratio along z.  A voxel that a border of two cells cuts has
    a centroid in each of them, and either counts.  (A centroid that near cannot lie in any other
    voxel, so the rule is that one exists.)
``voxel-distance``
    The point's own voxel has a map point, or one lies within d.
``distance``
    A map point lies within d (Euclidean, closed).

A point that is not finite is not explained by anything.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from shmmap import BadRequest

__all__ = ["DISTANCE", "MODES", "VOXEL", "VOXEL_DISTANCE", "CompareRule"]

MODES: Final = ("voxel", "voxel-distance", "distance")
VOXEL, VOXEL_DISTANCE, DISTANCE = range(3)


@dataclass(frozen=True, slots=True)
class CompareRule:
    """Which rule, and its distances.

    Attributes
    ----------
    mode
        ``voxel``, ``voxel-distance`` or ``distance``.
    distance
        d, metres (Autoware's ``distance_threshold``).
    z_ratio
        Height of a voxel over d (``downsize_ratio_z_axis``); of no account in ``distance``.

    Raises
    ------
    BadRequest
        The mode is unknown or a number is not positive.
    """

    mode: str = "voxel"
    distance: float = 0.5
    z_ratio: float = 0.5

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise BadRequest(f"compare mode {self.mode!r} is unknown", hint=f"use one of {', '.join(MODES)}")
        if not (math.isfinite(self.distance) and self.distance > 0):
            raise BadRequest(f"the distance must be positive, not {self.distance!r} m")
        if not (math.isfinite(self.z_ratio) and self.z_ratio > 0):
            raise BadRequest(f"the z ratio must be positive, not {self.z_ratio!r}")

    @property
    def code(self) -> int:
        """The mode as a number, for kernels."""
        return MODES.index(self.mode)

    @property
    def distance_z(self) -> float:
        """Height of a voxel, metres."""
        return self.distance * self.z_ratio

    @property
    def layer(self) -> str:
        """Layer that answers this rule; see `shmmap.layers.ground`."""
        d = self.distance
        if self.mode == "voxel":
            return f"search(leaf={d!r},of=voxel(leaf_x={d!r},leaf_y={d!r},leaf_z={self.distance_z!r}))"
        return f"search(leaf={d!r})"

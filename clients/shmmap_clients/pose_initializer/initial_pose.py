# SPDX-License-Identifier: Apache-2.0
"""What an initialization gives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shmmap_clients.ndt_scan_matcher import Result

__all__ = ["Alternative", "InitialPose"]


@dataclass(frozen=True, slots=True, eq=False)
class Alternative:
    """Another pose that the scan might have been taken from.

    Attributes
    ----------
    T_map_base : (4, 4) float64
    score
        Transform probability there.
    nvtl
        Nearest-voxel transformation likelihood.
    """

    T_map_base: NDArray[np.float64]
    score: float
    nvtl: float


@dataclass(frozen=True, slots=True, eq=False)
class InitialPose:
    """The best pose, and what speaks for it.

    Attributes
    ----------
    result
        The alignment that ended there.
    score
        Its transform probability: over all points, also those that found no map.
    reliable
        Whether the result is within all limits of trust.
    ground_z
        Height of the map's ground below the pose, metres: of the two heights that the search tries, the one
        that fits; None where there is none near.
    alternatives
        Others, best first; at least a metre or ten degrees away from the best and each other.
    candidates
        Poses that were scored.
    map_s, search_s
        Seconds for the map around the place, and for the search.
    """

    result: Result
    score: float
    reliable: bool
    ground_z: float | None
    alternatives: tuple[Alternative, ...]
    candidates: int
    map_s: float
    search_s: float

    @property
    def T_map_base(self) -> NDArray[np.float64]:  # noqa: N802
        """(4, 4) float64, metres."""
        return self.result.T_map_base

# SPDX-License-Identifier: Apache-2.0
"""Finds a vehicle again that localization has lost: the initializer, called wider and wider."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap import ShmmapError
from shmmap_clients.ndt_scan_matcher import Result, pose_from_matrix
from shmmap_clients.pose_initializer.candidates import RoughPose
from shmmap_clients.pose_initializer.initializer import PoseInitializer

__all__ = ["Relocalizer"]

_DOUBLINGS: Final = 3


class Relocalizer:
    """Searches around a probable pose; after each failure twice as far, up to eight times.

    Twice as far takes twice as many candidates to begin with.  The search begins at ``sigma_m`` again when it
    has found the vehicle.  It is a `shmmap_clients.ndt_scan_matcher.drive.follower.Relocalize`.

    Parameters
    ----------
    initializer
        Returns the initializer, which stays the caller's to close; called at the first search, for it has
        a map of its own.
    sigma_m, sigma_yaw
        Standard deviation of x and y, metres, and of the heading, radians, at the first attempt.

    Attributes
    ----------
    error
        Why the last search could not be made, or None.
    """

    def __init__(
        self, initializer: Callable[[], PoseInitializer], *, sigma_m: float = 2.0, sigma_yaw: float = 0.1745
    ) -> None:
        self._make = initializer
        self._initializer: PoseInitializer | None = None
        self._sigma_m = sigma_m
        self._sigma_yaw = sigma_yaw
        self._failures = 0
        self.error: ShmmapError | None = None

    def __call__(self, points: NDArray[np.floating], T_guess: NDArray[np.float64]) -> Result | None:
        """Return a trusted result, or None.

        Parameters
        ----------
        points : (N, 3)
            The scan, base frame, metres.
        T_guess : (4, 4)
            Where it was probably taken.
        """
        wider = 2 ** min(self._failures, _DOUBLINGS)
        x, y, z, roll, pitch, yaw = pose_from_matrix(T_guess).tolist()
        rough = RoughPose(
            x, y, z, roll, pitch, yaw, sigma_m=self._sigma_m * wider, sigma_yaw=self._sigma_yaw * wider
        )
        self._failures += 1
        self.error = None
        try:
            if self._initializer is None:
                self._initializer = self._make()
            found = self._initializer.initialize(points, rough, effort=wider)
        except ShmmapError as error:  # no map there, no daemon: the next scan may have better luck
            self.error = error
            return None
        if not found.reliable:
            return None
        self._failures = 0
        return found.result

# SPDX-License-Identifier: Apache-2.0
"""Localization of a drive, scan by scan: predict, take the newest map, align, judge."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from shmmap import build_layer
from shmmap_clients.ndt_scan_matcher.drive.motion_prediction import Prediction
from shmmap_clients.ndt_scan_matcher.map.map_updater import MapUpdater
from shmmap_clients.ndt_scan_matcher.map.voxel_map import VoxelMap
from shmmap_clients.ndt_scan_matcher.matching.matcher import NdtMatcher
from shmmap_clients.ndt_scan_matcher.matching.result import Result
from shmmap_clients.scans.scan_sequence import Scan

__all__ = ["Follower", "Frame", "thinned"]


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """What became of one scan.

    Attributes
    ----------
    name, stamp_s
        The scan's.
    result
        Of the alignment.
    T_guess : (4, 4)
        Where it began.
    T_truth : (4, 4) or None
        Where the scan was really taken, if it says so.
    thin_s, map_s, align_s
        Seconds for thinning the scan, for taking the map, for the alignment.
    waited
        Whether the scan had to wait for the map.
    """

    name: str
    stamp_s: float
    result: Result
    T_guess: NDArray[np.float64] = field(repr=False)
    T_truth: NDArray[np.float64] | None = field(repr=False)
    thin_s: float
    map_s: float
    align_s: float
    waited: bool

    @property
    def latency_s(self) -> float:
        """From having the scan to having the pose."""
        return self.thin_s + self.map_s + self.align_s


def thinned(points: NDArray[np.floating], edge: float | None) -> NDArray[np.floating]:
    """Return one point per cube of ``edge`` metres, their mean; the points themselves without an edge."""
    if edge is None or not len(points):
        return points
    columns = build_layer(f"voxel(leaf={edge!r})", points).columns
    return np.asarray(columns["xyz"], points.dtype)


class Follower:
    """Aligns scans one after the other.

    Parameters
    ----------
    matcher, maps, prediction
        What aligns, what keeps the map, what guesses.
    thin
        Scans are thinned to one point per cube of this many metres; None: not at all.
    """

    def __init__(
        self, matcher: NdtMatcher, maps: MapUpdater, prediction: Prediction, *, thin: float | None = 1.0
    ) -> None:
        self._matcher = matcher
        self._maps = maps
        self._prediction = prediction
        self._thin = thin
        self._map: VoxelMap | None = None

    def follow(self, scan: Scan) -> Frame:
        """Align the next scan.

        Raises
        ------
        ShmmapError
            There is no map.
        """
        begin = time.perf_counter()
        points = thinned(scan.xyz, self._thin)
        T_guess = self._prediction.predict(scan.stamp_s)
        thinned_at = time.perf_counter()
        vx, vy = self._prediction.velocity
        voxel_map, waited = self._maps.map_at(float(T_guess[0, 3]), float(T_guess[1, 3]), vx=vx, vy=vy)
        if voxel_map is not self._map:
            self._matcher.set_map(voxel_map)
            self._map = voxel_map
        had_map_at = time.perf_counter()
        result = self._matcher.align(points, T_guess)
        done_at = time.perf_counter()
        # a pose that is not to be trusted teaches the prediction nothing but to go on
        believed = result.T_map_base if result.trustworthy else T_guess
        self._prediction.correct(scan.stamp_s, believed)
        return Frame(
            scan.name,
            scan.stamp_s,
            result,
            T_guess,
            scan.T_map_sensor,
            thinned_at - begin,
            had_map_at - thinned_at,
            done_at - had_map_at,
            waited,
        )

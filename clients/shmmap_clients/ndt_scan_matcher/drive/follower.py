# SPDX-License-Identifier: Apache-2.0
"""Localization of a drive, scan by scan: predict, take the newest map, align, judge; search when lost.

The vehicle is tracked, uncertain or lost::

    uncertain --trusted--> tracking --not trusted--> uncertain --not trusted, repeatedly--> lost
    tracking, uncertain --no map--> lost
    lost --trusted, or relocalized--> tracking

A drive begins ``uncertain``, or ``lost`` if its first pose is only roughly known.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest
from shmmap_clients.ndt_scan_matcher.drive.motion_prediction import MotionPrediction
from shmmap_clients.ndt_scan_matcher.map.map_updater import MapUpdater
from shmmap_clients.ndt_scan_matcher.map.voxel_map import VoxelMap
from shmmap_clients.ndt_scan_matcher.matching.matcher import NdtMatcher
from shmmap_clients.ndt_scan_matcher.matching.result import Result
from shmmap_clients.scans.scan_file import thinned
from shmmap_clients.scans.scan_sequence import Scan

State = Literal["tracking", "uncertain", "lost"]
LOST_AFTER: Final = 5  # Autoware's ndt_scan_matcher reports an error after as many rejected poses
_BLIND_SEARCHES: Final = 4
"""Searches with a single scan, each twice as far: a vehicle that was not lost cannot be farther."""
_SHORT_S: Final = 0.2  # time in which a vehicle stays within the reach of an alignment
_SAME_M: Final = 0.5
Relocalize = Callable[[NDArray[np.floating], NDArray[np.float64]], Result | None]


class Tracking:
    """State machine: after each result, the vehicle is tracked, uncertain or lost.

    Parameters
    ----------
    lost_after
        Number of consecutive untrusted results after which the vehicle is lost; one without a map suffices.
    lost
        Whether the vehicle is lost at the beginning.
    """

    def __init__(self, lost_after: int = LOST_AFTER, *, lost: bool = False) -> None:
        if lost_after < 1:
            raise BadRequest(f"lost_after must be positive, it is {lost_after}")
        self._lost_after = lost_after
        self.restart(lost=lost)

    def restart(self, *, lost: bool) -> None:
        """Begin again."""
        self._untrusted = 0
        self.state: State = "lost" if lost else "uncertain"

    def update(self, result: Result) -> State:
        """Return the state after the next result."""
        if result.trustworthy:
            self._untrusted = 0
            self.state = "tracking"
            return self.state
        self._untrusted += 1
        if self.state != "lost":
            lost = result.no_map or self._untrusted >= self._lost_after
            self.state = "lost" if lost else "uncertain"
        return self.state


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """The result of one scan.

    Attributes
    ----------
    name, stamp_s
        Name and time of the scan.
    result
        Result of the alignment.
    T_guess : (4, 4)
        Pose where the alignment began.
    T_truth : (4, 4) or None
        True pose of the scan, if the scan has one.
    state
        Whether the vehicle is tracked, uncertain or lost, see `Tracking`.
    relocalized
        Whether the result is from a search for the lost vehicle.
    clock_jumped
        Whether the time since the last scan was implausible, so that no motion was predicted.
    thin_s, map_s, align_s, relocalize_s
        Seconds for thinning the scan, getting the map, the alignment, and the search.
    waited
        Whether the scan had to wait for the map.
    """

    name: str
    stamp_s: float
    result: Result
    T_guess: NDArray[np.float64] = field(repr=False)
    T_truth: NDArray[np.float64] | None = field(repr=False)
    state: State
    relocalized: bool
    clock_jumped: bool
    thin_s: float
    map_s: float
    align_s: float
    relocalize_s: float
    waited: bool

    @property
    def latency_s(self) -> float:
        """Time from receiving the scan to the pose, seconds."""
        return self.thin_s + self.map_s + self.align_s + self.relocalize_s


class Follower:
    """Aligns scans one after the other.

    Parameters
    ----------
    matcher, maps, prediction
        Scan matcher, updater of the map, and prediction of the next pose.
    thin
        Edge of the cubes that keep one point each, metres; None: no thinning.
    tracking
        Decides when the vehicle is lost.
    relocalize
        Called with each scan of a lost vehicle, (N, 3), metres, and the last known pose, (4, 4); returns
        a trusted result, or None.  Where the motion is unknown (at the beginning, after a jump of the
        clock), it is called at the first untrusted result; after a long gap, even at a trusted one.
    """

    def __init__(
        self,
        matcher: NdtMatcher,
        maps: MapUpdater,
        prediction: MotionPrediction,
        *,
        thin: float | None = 1.0,
        tracking: Tracking | None = None,
        relocalize: Relocalize | None = None,
    ) -> None:
        self._matcher = matcher
        self._maps = maps
        self._prediction = prediction
        self._thin = thin
        self._tracking = tracking if tracking is not None else Tracking()
        self._relocalize = relocalize
        self._jumped = False
        self._map: VoxelMap | None = None

    @property
    def map(self) -> VoxelMap | None:
        """The map that the last scan was aligned with; None before the first."""
        return self._map

    def restart(self, T_map_base: NDArray[np.float64], *, lost: bool) -> None:
        """Begin again at a pose, (4, 4); ``lost`` if it is only roughly known."""
        self._prediction.restart(T_map_base)
        self._tracking.restart(lost=lost)
        self._jumped = True

    def follow(self, scan: Scan) -> Frame:
        """Align the next scan.

        Raises
        ------
        ShmmapError
            The daemon cannot provide the map.
        """
        begin = time.perf_counter()
        points = thinned(scan.xyz, self._thin)
        T_guess = self._prediction.predict(scan.stamp_s)
        blind = self._prediction.is_blind(scan.stamp_s)
        step_s = self._prediction.step(scan.stamp_s)
        thinned_at = time.perf_counter()
        vx, vy = self._prediction.velocity
        voxel_map = self._maps.map_at(
            float(T_guess[0, 3]), float(T_guess[1, 3]), vx=vx, vy=vy, jumped=self._jumped
        )
        self._jumped = False
        if voxel_map is not self._map:
            self._matcher.set_map(voxel_map)
            self._map = voxel_map
        had_map_at = time.perf_counter()
        result = self._matcher.align(points, T_guess)
        aligned_at = time.perf_counter()
        state = self._tracking.update(result)
        relocalized = False
        if state == "lost":
            searches = 1
        elif blind and not result.trustworthy:
            searches = _BLIND_SEARCHES
        else:  # an alignment that starts metres off may end at a wrong pose that looks right
            unknown = step_s is None or (step_s > _SHORT_S and not self._prediction.knows_velocity)
            searches = int(blind and unknown)
        for _ in range(searches if self._relocalize is not None else 0):
            assert self._relocalize is not None  # noqa: S101  # else there is no search
            found = self._relocalize(points, self._prediction.T_known)
            if found is not None and _is_better(found, result):
                result, relocalized, self._jumped = found, True, True
                state = self._tracking.update(result)
            if result.trustworthy:
                break
        self._prediction.correct(scan.stamp_s, result.T_map_base if result.trustworthy else None)
        if state == "lost" or (relocalized and not blind):
            self._prediction.hold()
        return Frame(
            name=scan.name,
            stamp_s=scan.stamp_s,
            result=result,
            T_guess=T_guess,
            T_truth=scan.T_map_sensor,
            state=state,
            relocalized=relocalized,
            clock_jumped=step_s is None,
            thin_s=thinned_at - begin,
            map_s=had_map_at - thinned_at,
            align_s=aligned_at - had_map_at,
            relocalize_s=time.perf_counter() - aligned_at,
            waited=self._maps.waited,
        )


def _is_better(found: Result, result: Result) -> bool:
    """Return whether a search found a different pose than the alignment, where the scan fits better."""
    if not result.trustworthy:
        return True
    apart = float(np.linalg.norm(found.T_map_base[:3, 3] - result.T_map_base[:3, 3]))
    return apart > _SAME_M and found.transform_probability > result.transform_probability

# SPDX-License-Identifier: Apache-2.0
"""Initialization of a pose: map around the rough pose, height of the ground, candidates, alignments."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Any, Final, NoReturn

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest, Client, MapWindow, NoAnswer, ShmmapError
from shmmap.layers import canonical_layer, ground_height
from shmmap_clients.map_extent import NoMapHere, map_extent
from shmmap_clients.ndt_scan_matcher import (
    DeviceError,
    DeviceOptions,
    Limits,
    NdtMatcher,
    Result,
    Settings,
    TrustLimits,
    VoxelCell,
    VoxelMap,
    cell_from_layer,
    matrix_from_pose,
    pose_from_matrix,
)
from shmmap_clients.pose_initializer.candidates import ParzenEstimator, RoughPose

__all__ = ["Alternative", "InitialPose", "InitializerRules", "PoseInitializer", "Relocalizer"]

_APART_M: Final = 1.0
_APART_YAW: Final = math.radians(10.0)
_SEED_APART_M: Final = 0.5
_SEED_APART_YAW: Final = math.radians(3.0)
_SAME_HEIGHT_M: Final = 0.3
_DOUBLINGS: Final = 3


@dataclass(frozen=True, slots=True, eq=False)
class Alternative:
    """Another possible pose of the scan.

    Attributes
    ----------
    T_map_base : (4, 4) float64
    score
        Transform probability of this pose.
    nvtl
        Nearest-voxel transformation likelihood.
    """

    T_map_base: NDArray[np.float64]
    score: float
    nvtl: float


@dataclass(frozen=True, slots=True, eq=False)
class InitialPose:
    """The best pose, with its evidence.

    Attributes
    ----------
    result
        Alignment that ended at this pose.
    score
        Transform probability of the alignment, over all points, including those without map.
    reliable
        Whether the result meets all limits of trust.
    ground_z
        Height of the map's ground below the pose, metres: the better of the two heights that the search
        tries; None if there is no ground near.
    alternatives
        Other poses, best first, at least a metre or ten degrees from the best and from each other.
    candidates
        Number of scored poses.
    map_s, search_s
        Seconds for loading the map, and for the search.
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


@dataclass(frozen=True, slots=True)
class InitializerRules:
    """Parameters of the search.

    Attributes
    ----------
    map_radius
        Half-side of the requested square of the map, metres.
    leaf
        Edge of a voxel, metres.
    height
        Height of the scan's frame above the ground, metres; 0 for Autoware's base_link.  None: use the rough
        pose's z, without the map's ground.
    candidates
        Number of scored poses: half from the rough pose, half where high scores are expected.
    starts
        Number of best candidates to align.
    finals
        Number of best alignments to repeat with the whole scan.
    scoring_points
        Number of points of the scan for scoring candidates and for aligning the starts.
    wait_s
        Time for the map to load, seconds.  The first use on a machine compiles the kernels of its layers,
        which takes a minute or more on a slow or busy one.
    seed
        Seed of the random candidates; the same seed gives the same search.
    """

    map_radius: float = 150.0
    leaf: float = 2.0
    height: float | None = 0.0
    candidates: int = 200
    starts: int = 10
    finals: int = 3
    scoring_points: int = 500
    wait_s: float = 300.0
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.candidates, self.starts, self.finals, self.scoring_points) < 1:
            raise BadRequest("numbers of candidates, starts, finals and points must be positive")


class PoseInitializer:
    """Searcher of initial poses, which keeps its map for the next search.

    Parameters
    ----------
    client
        A session with the daemon, or a socket as in `shmmap.connect` for a session of its own.
    rules
    limits, trust
        Limits of the final alignments, as in `NdtMatcher`.
    backend, device, fallback
        Backend that computes, as in `Settings`.
    threads
        Number of threads, as in `NdtMatcher`.

    Raises
    ------
    ShmmapError
        The daemon cannot be reached.
    """

    def __init__(
        self,
        client: Client | str | os.PathLike[str] | None = None,
        rules: InitializerRules | None = None,
        *,
        limits: Limits | None = None,
        trust: TrustLimits | None = None,
        backend: str = "numba",
        device: DeviceOptions | None = None,
        fallback: str | None = None,
        threads: int = 1,
    ) -> None:
        self.rules = rules if rules is not None else InitializerRules()
        self._voxels = canonical_layer(f"ndt(leaf={self.rules.leaf!r})")
        self._ground = canonical_layer("ground")
        computes: dict[str, Any] = {
            "backend": backend,
            "device": device if device is not None else DeviceOptions(),
            "fallback": fallback,
        }
        few = Limits(source_points=self.rules.scoring_points)
        if limits is not None:
            few = replace(few, voxels=limits.voxels, map_bytes=limits.map_bytes)
        self._coarse = NdtMatcher(
            Settings(steady=True, epsilon=0.05, **computes), limits=few, threads=threads
        )
        self._fine = NdtMatcher(
            Settings(mode="coarse_fine", **computes), limits=limits, trust=trust, threads=threads
        )
        self._window = MapWindow(
            client,
            self.rules.map_radius,
            layers=(self._voxels, self._ground),
            shape="square",
            update_distance=0.0,
            background=False,
            name="shmmap-pose-init",
        )
        self._map = VoxelMap({})
        self._versions: dict[tuple[str, str], int] = {}

    def __enter__(self) -> PoseInitializer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Release the map, and end the initializer's own session, if any."""
        self._window.close()
        self._coarse.close()
        self._fine.close()

    def initialize(self, points: NDArray[np.floating], rough: RoughPose, *, effort: int = 1) -> InitialPose:
        """Find the pose of a scan.

        Parameters
        ----------
        points : (N, 3)
            The scan, base frame, metres.
        rough
            Rough pose of the scan.
        effort
            Factor on the number of candidates drawn from the rough pose.

        Raises
        ------
        NoMapHere
            The map has no cells around the rough pose.
        ShmmapError
            The daemon cannot be reached.
        """
        began = time.perf_counter()
        self._take_map(rough)
        had_map = time.perf_counter()
        height = self.rules.height
        # the rough z is a guess from GNSS; the map's ground is known to centimetres
        grounds = self._grounds(rough.x, rough.y)
        heights = [z + height for z in grounds] if height is not None and grounds else [rough.z]

        def pose_of(candidate: NDArray[np.float64], z: float) -> NDArray[np.float64]:
            x, y, yaw = candidate
            return np.array([x, y, z, rough.roll, rough.pitch, yaw])

        def scores(batch: NDArray[np.float64], z: float) -> NDArray[np.float64]:
            poses = np.array([pose_of(one, z) for one in batch])
            return np.array([at.score for at in self._coarse.evaluate(points, poses)])

        estimator = ParzenEstimator(rough, self.rules.seed)
        half = max(1, self.rules.candidates // 2)
        batches = [half * effort, *(_split(self.rules.candidates - half, 4))]
        first = estimator.first(batches[0])
        by_height = [scores(first, z) for z in heights]
        best_height = int(np.argmax([one.max() for one in by_height]))
        z = heights[best_height]
        estimator.learn(first, by_height[best_height])
        for size in batches[1:]:
            batch = estimator.next(size)
            estimator.learn(batch, scores(batch, z))
        starts = estimator.best(self.rules.starts, _SEED_APART_M, _SEED_APART_YAW)
        near = self._coarse.align_many(points, [matrix_from_pose(pose_of(start, z)) for start in starts])
        near.sort(key=lambda result: -result.transform_probability)
        finals = self._fine.align_many(points, [one.T_map_base for one in _apart(near)[: self.rules.finals]])
        finals.sort(key=lambda result: -result.transform_probability)
        best = finals[0]
        others = [
            Alternative(one.T_map_base, one.transform_probability, one.nvtl) for one in _apart(finals)[1:]
        ]
        return InitialPose(
            result=best,
            score=best.transform_probability,
            reliable=best.trustworthy,
            ground_z=self._ground_below(best.T_map_base),
            alternatives=tuple(others),
            candidates=sum(batches),
            map_s=had_map - began,
            search_s=time.perf_counter() - had_map,
        )

    @property
    def trust(self) -> TrustLimits:
        """Limits of trust for the last searched map."""
        return self._fine.trust

    @property
    def fault(self) -> DeviceError | None:
        """Reason why the fallback computes; None while it does not."""
        return self._coarse.fault or self._fine.fault

    def _grounds(self, x: float, y: float) -> list[float]:
        """Return heights of the ground to try: the median, then the lowest if it differs.

        If the rough pose is beside the street, more than half of the columns may be above the ground.
        """
        cells = [cell for cell in self._window.cells if cell.layer == self._ground]
        grids = [(cell["min"], cell.header.lattice) for cell in cells]
        known = [(low, lattice) for low, lattice in grids if lattice is not None]
        median, lowest = ground_height(known, x, y), ground_height(known, x, y, rule="min")
        if median is None or lowest is None:
            return []
        return [median] if abs(lowest - median) < _SAME_HEIGHT_M else [median, lowest]

    def _ground_below(self, T_map_base: NDArray[np.float64]) -> float | None:
        """Return the tried height of the ground that fits a pose best."""
        x, y, z = T_map_base[:3, 3].tolist()
        grounds = self._grounds(x, y)
        if self.rules.height is None:
            return grounds[0] if grounds else None
        stands_at = z - self.rules.height
        return min(grounds, key=lambda ground: abs(ground - stands_at), default=None)

    def _take_map(self, rough: RoughPose) -> None:
        """Fetch the map around a position."""
        self._window.move_to(rough.x, rough.y, wait=self.rules.wait_s)
        voxels = {cell.id: cell for cell in self._window.cells if cell.layer == self._voxels}
        if not voxels:
            self._window_is_empty(rough)
        versions = self._window.versions()
        if versions != self._versions:
            known = self._map.cells
            kept: dict[str, VoxelCell] = {}
            for key, cell in voxels.items():
                same = self._versions.get((key, self._voxels)) == versions[(key, self._voxels)]
                kept[key] = known[key] if same and key in known else cell_from_layer(cell)
            limits = self._fine.limits
            self._map = self._fine.prepare(
                VoxelMap(
                    kept,
                    max_voxels=limits.voxels,
                    max_bytes=limits.max_map_bytes,
                    centre=(rough.x, rough.y),
                    previous=self._map,
                )
            )
            self._coarse.prepare(self._map)
            self._coarse.set_map(self._map)
            self._fine.set_map(self._map)
            self._versions = versions

    def _window_is_empty(self, rough: RoughPose) -> NoReturn:
        """Raise an error that explains why there is no map around the position."""
        if not self._window.complete:
            raise NoAnswer(
                f"no cell around ({rough.x:.3f}, {rough.y:.3f}) was loaded within {self.rules.wait_s:g} s",
                hint="`shmmap status` shows whether the daemon still loads, or has no memory left",
            )
        raise NoMapHere(
            f"no map within {self.rules.map_radius:g} m of the rough pose:"
            f" {map_extent(self._window.client, (rough.x, rough.y))}"
        )


def _split(count: int, parts: int) -> list[int]:
    sizes = [count * (part + 1) // parts - count * part // parts for part in range(parts)]
    return [size for size in sizes if size]


def _apart(results: list[Result]) -> list[Result]:
    """Return the poses that are not near a better one."""
    kept: list[Result] = []
    for result in results:
        T = result.T_map_base
        for other in kept:
            off = np.linalg.inv(other.T_map_base) @ T
            turned = math.acos(max(-1.0, min(1.0, (float(np.trace(off[:3, :3])) - 1.0) / 2.0)))
            if float(np.linalg.norm(off[:3, 3])) < _APART_M and turned < _APART_YAW:
                break
        else:
            kept.append(result)
    return kept


class Relocalizer:
    """Search around a predicted pose, doubling the radius after each failure, up to eight times.

    A doubled radius also doubles the number of first candidates.  After success, the radius is ``sigma_m``
    again.  This class is a `shmmap_clients.ndt_scan_matcher.drive.follower.Relocalize`.

    Parameters
    ----------
    initializer
        Returns the initializer, which has its own map, and which the caller closes; called at the first
        search.
    sigma_m, sigma_yaw
        Standard deviation of x and y, metres, and of the heading, radians, at the first attempt.

    Attributes
    ----------
    error
        Error that prevented the last search, or None.
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
            Predicted pose of the scan.
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
        except ShmmapError as error:  # no map or no daemon: the next scan may succeed
            self.error = error
            return None
        if not found.reliable:
            return None
        self._failures = 0
        return found.result

# SPDX-License-Identifier: Apache-2.0
"""Initialization of a pose: map around the rough pose, heights of its grounds, candidates, alignments."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, NoReturn

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest, Client, MapWindow, NoAnswer, ShmmapError
from shmmap.layers import canonical_layer, ground_height
from shmmap_clients.closed_at_end import ClosedAtEnd
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
from shmmap_clients.pose_initializer.grounds import (
    Ground,
    flat_pieces,
    ground_at,
    grounds_of,
    levels_of,
)

_APART_M: Final = 1.0
_APART_YAW: Final = math.radians(10.0)
_SEED_APART_M: Final = 0.5
_SEED_APART_YAW: Final = math.radians(3.0)
_DOUBLINGS: Final = 3
_GROUND_REACH_M: Final = 4.0
_MAX_GROUND_REACH_M: Final = 12.0
_BOTH_FIT: Final = 0.7  # of the best score
_NUMBERS: Final = ("no", "one", "two", "three", "four", "five")


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
        Whether the result meets all limits of trust, and its level is beyond doubt.
    ground_z
        Height of the map's ground below the pose, metres: of the heights that the search tries the one that
        the pose fits; None if there is no ground near.
    grounds
        Heights of all grounds at the rough pose, lowest first, metres: several on bridges, above tunnels, and
        in car parks.
    level_doubt
        Why the pose may be on another ground; None: it is not in doubt.
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
    grounds: tuple[float, ...]
    level_doubt: str | None
    alternatives: tuple[Alternative, ...]
    candidates: int
    map_s: float
    search_s: float

    @property
    def failed_limits(self) -> tuple[str, ...]:
        """Names of the result's failed limits, and ``level`` if that is in doubt; none if reliable."""
        return self.result.failed_limits + (() if self.level_doubt is None else ("level",))

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

    def batches(self, effort: int = 1) -> list[int]:
        """Return the numbers of candidates to draw: from the rough pose, then four times where good."""
        half = max(1, self.candidates // 2)
        return [half * effort, *_split(self.candidates - half, 4)]


class PoseInitializer(ClosedAtEnd):
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
        if rough.z is None and self.rules.height is None:
            raise BadRequest("a search without the map's ground needs the rough pose's z")
        self._take_map(rough)
        had_map = time.perf_counter()
        grounds = self._grounds(rough)
        searched = self._search_grounds(points, rough, grounds, effort)
        found = sorted((one for results in searched.values() for one in results), key=_by_score)
        apart = _apart(found)
        best, doubt = apart[0], None
        if len(grounds) > 1 and self.rules.height is not None:
            best, doubt = self._choose(rough, grounds, searched, apart)
        return InitialPose(
            result=best,
            score=best.transform_probability,
            reliable=best.trustworthy and doubt is None,
            ground_z=self._ground_below(best, grounds),
            grounds=tuple(ground.z for ground in grounds),
            level_doubt=doubt,
            alternatives=tuple(
                Alternative(one.T_map_base, one.transform_probability, one.nvtl)
                for one in _apart([best, *apart])[1:]
            ),
            candidates=sum(self.rules.batches(effort)) * len(searched),
            map_s=had_map - began,
            search_s=time.perf_counter() - had_map,
        )

    def _search_grounds(
        self, points: NDArray[np.floating], rough: RoughPose, grounds: Sequence[Ground], effort: int
    ) -> dict[Ground | None, list[Result]]:
        """Return the best alignments of each ground searched, the best first; None: without the map's ground.

        The ground that the rough z means is searched alone, if the scan fits there.
        """
        height = self.rules.height
        if height is None or not grounds:
            return {None: self._search(points, rough, [rough.z or 0.0], effort)}
        searched: dict[Ground | None, list[Result]] = {}
        meant = self._meant(rough, grounds)
        for ground in sorted(grounds, key=lambda one: one != meant):
            searched[ground] = self._search(points, rough, [z + height for z in ground.heights], effort)
            if ground == meant and self._fits(searched[ground][0], ground, grounds):
                break
        return searched

    def _search(
        self, points: NDArray[np.floating], rough: RoughPose, heights: Sequence[float], effort: int
    ) -> list[Result]:
        """Return the best alignments from candidates at the one of these heights that scores best."""

        def pose_of(candidate: NDArray[np.float64], z: float) -> NDArray[np.float64]:
            x, y, yaw = candidate
            return np.array([x, y, z, rough.roll, rough.pitch, yaw])

        def scores(batch: NDArray[np.float64], z: float) -> NDArray[np.float64]:
            poses = np.array([pose_of(one, z) for one in batch])
            return np.array([at.score for at in self._coarse.evaluate(points, poses)])

        estimator = ParzenEstimator(rough, self.rules.seed)
        first_size, *sizes = self.rules.batches(effort)
        first = estimator.first(first_size)
        by_height = [scores(first, z) for z in heights]
        best_height = int(np.argmax([one.max() for one in by_height]))
        z = heights[best_height]
        estimator.learn(first, by_height[best_height])
        for size in sizes:
            batch = estimator.next(size)
            estimator.learn(batch, scores(batch, z))
        starts = estimator.best(self.rules.starts, _SEED_APART_M, _SEED_APART_YAW)
        near = self._coarse.align_many(points, [matrix_from_pose(pose_of(start, z)) for start in starts])
        near.sort(key=_by_score)
        finals = self._fine.align_many(points, [one.T_map_base for one in _apart(near)[: self.rules.finals]])
        return sorted(finals, key=_by_score)

    def _choose(
        self,
        rough: RoughPose,
        grounds: Sequence[Ground],
        searched: Mapping[Ground | None, list[Result]],
        apart: Sequence[Result],
    ) -> tuple[Result, str | None]:
        """Return the best result, and why its ground is in doubt, where there are several."""
        several = _several(grounds)
        meant = self._meant(rough, grounds)
        if meant is not None:
            there = searched[meant][0]
            if self._fits(there, meant, grounds):
                return there, None
            other = self._ground_of(apart[0], grounds)
            if other == meant or not apart[0].trustworthy:
                return apart[0], None
            return apart[0], (
                f"{several}: the rough z means the one at {meant.z:.1f} m,"
                f" the scan fits the one at {other.z:.1f} m"
            )
        best = apart[0]
        least = _BOTH_FIT * best.transform_probability
        fitting = {
            self._ground_of(one, grounds).z
            for one in apart
            if one.trustworthy and one.transform_probability >= least
        }
        if len(fitting) < 2:
            return best, None
        return best, f"{several}: the scan fits {'both' if len(grounds) == 2 else _listed(sorted(fitting))}"

    def _meant(self, rough: RoughPose, grounds: Sequence[Ground]) -> Ground | None:
        """Return the ground on which the rough z is, if that can be said."""
        if rough.z is None or self.rules.height is None:
            return None
        return ground_at(grounds, rough.z - self.rules.height)

    def _fits(self, result: Result, ground: Ground, grounds: Sequence[Ground]) -> bool:
        return result.trustworthy and self._ground_of(result, grounds) == ground

    @property
    def trust(self) -> TrustLimits:
        """Limits of trust for the last searched map."""
        return self._fine.trust

    @property
    def fault(self) -> DeviceError | None:
        """Reason why the fallback computes; None while it does not."""
        return self._coarse.fault or self._fine.fault

    def _grounds(self, rough: RoughPose) -> list[Ground]:
        """Return the grounds at the rough pose, lowest first.

        Heights of the ``ground`` layer are the median, and the lowest: if the rough pose is beside the
        street, more than half of the columns may be above the ground.
        """
        cells = [cell for cell in self._window.cells if cell.layer == self._ground]
        grids = [(cell["min"], cell.header.lattice) for cell in cells]
        known = [(low, lattice) for low, lattice in grids if lattice is not None]
        spread = float(np.linalg.norm(rough.factor[:2], axis=1).max())
        reach_m = min(_GROUND_REACH_M + 2.0 * spread, _MAX_GROUND_REACH_M)
        pieces, columns = flat_pieces(self._map.cells.values(), rough.x, rough.y, reach_m)
        return grounds_of(
            ground_height(known, rough.x, rough.y),
            ground_height(known, rough.x, rough.y, rule="min"),
            levels_of(pieces, columns),
        )

    def _ground_of(self, result: Result, grounds: Sequence[Ground]) -> Ground:
        """Return the ground on which a result's pose is."""
        stands_at = self._stands_at(result)
        return min(grounds, key=lambda ground: min(abs(z - stands_at) for z in ground.heights))

    def _stands_at(self, result: Result) -> float:
        return float(result.T_map_base[2, 3]) - (self.rules.height or 0.0)

    def _ground_below(self, result: Result, grounds: Sequence[Ground]) -> float | None:
        """Return the tried height of the ground that a result's pose fits best."""
        if not grounds:
            return None
        stands_at = self._stands_at(result)
        return min(self._ground_of(result, grounds).heights, key=lambda z: abs(z - stands_at))

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


def _by_score(result: Result) -> float:
    """Order the best results first."""
    return -result.transform_probability


def _several(grounds: Sequence[Ground]) -> str:
    """Return their number and heights, as "two grounds, -1.9 and 6.1 m"."""
    count = _NUMBERS[len(grounds)] if len(grounds) < len(_NUMBERS) else str(len(grounds))
    return f"{count} grounds, {_listed([ground.z for ground in grounds])}"


def _listed(heights: Sequence[float]) -> str:
    *first, last = (f"{round(z, 1) + 0.0:.1f}" for z in heights)  # + 0.0: no -0.0
    return f"{', '.join(first)} and {last} m" if first else f"{last} m"


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
    knows_z
        Whether the height of the first predicted pose is known; after a success it is.

    Attributes
    ----------
    error
        Error that prevented the last search, or None.
    """

    def __init__(
        self,
        initializer: Callable[[], PoseInitializer],
        *,
        sigma_m: float = 2.0,
        sigma_yaw: float = 0.1745,
        knows_z: bool = True,
    ) -> None:
        self._make = initializer
        self._initializer: PoseInitializer | None = None
        self._sigma_m = sigma_m
        self._sigma_yaw = sigma_yaw
        self._knows_z = self._knows_first_z = knows_z
        self._failures = 0
        self.error: ShmmapError | None = None

    def restart(self) -> None:
        """Begin again, around another pose."""
        self._failures, self._knows_z = 0, self._knows_first_z

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
            x,
            y,
            z if self._knows_z else None,
            roll,
            pitch,
            yaw,
            sigma_m=self._sigma_m * wider,
            sigma_yaw=self._sigma_yaw * wider,
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
        self._failures, self._knows_z = 0, True
        return found.result

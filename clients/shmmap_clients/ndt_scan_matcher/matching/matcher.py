# SPDX-License-Identifier: Apache-2.0
"""`NdtMatcher`: aligns scans with a map of Gaussians, and predicts the longest time of an alignment."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest
from shmmap_clients.closed_at_end import ClosedAtEnd
from shmmap_clients.ndt_scan_matcher.backends.backend import Backend, DeviceError, UploadStatistics
from shmmap_clients.ndt_scan_matcher.backends.registry import backend_named
from shmmap_clients.ndt_scan_matcher.map.voxel_map import VoxelMap
from shmmap_clients.ndt_scan_matcher.matching.evaluation import (
    Evaluation,
    Neighbors,
    Scoring,
    gauss_for,
    pose_from_matrix,
)
from shmmap_clients.ndt_scan_matcher.matching.more_thuente import MAX_TRIALS
from shmmap_clients.ndt_scan_matcher.matching.newton import (
    VARIANTS,
    Ascent,
    StepRule,
    ascend,
    climb,
    started,
    variant_named,
)
from shmmap_clients.ndt_scan_matcher.matching.result import (
    Extent,
    Result,
    TrustLimits,
    covariance_of,
    evidence_of,
    extent_of,
    oscillations,
)
from shmmap_clients.ndt_scan_matcher.matching.settings import Cut, Limits, Settings, TimeBound, rule_of

_REPEATS = 3
_REACH: Final = {"direct1": 1, "direct7": 7, "radius": 27}
_SHARED_PLACES: Final = 4  # where four cells meet, each has its own voxel in the same lattice place


@dataclass(frozen=True, slots=True)
class Regularization:
    """A weak pull along the heading towards another estimate of the position, as in Autoware.

    Adds -scale * neighbours * (longitudinal distance)^2 to the score.

    Attributes
    ----------
    x, y
        The other estimate (from GNSS, for example), metres, map frame.
    scale
        ``regularization_scale_factor`` in Autoware, 0.01 by default there.
    """

    x: float
    y: float
    scale: float = 0.01

    def applied(self, evaluation: Evaluation, pose: NDArray[np.float64]) -> Evaluation:
        """Return the evaluation with the term added (multigrid_ndt_omp, computeDerivatives)."""
        dx, dy = self.x - float(pose[0]), self.y - float(pose[1])
        along = np.array([math.cos(pose[5]), math.sin(pose[5])])
        distance = along[0] * dx + along[1] * dy
        weight = self.scale * evaluation.neighbours
        gradient, hessian = evaluation.gradient.copy(), evaluation.hessian.copy()
        gradient[:2] += weight * 2.0 * distance * along
        hessian[:2, :2] -= weight * 2.0 * np.outer(along, along)
        return replace(
            evaluation,
            score=evaluation.score - weight * distance**2,
            gradient=gradient,
            hessian=hessian,
        )


class NdtMatcher(ClosedAtEnd):
    """Scan matcher for a map; its constructor allocates all buffers.

    Parameters
    ----------
    settings
    limits
    trust
        Limits that a trusted result must meet.
    backend
        Backend to use instead of the one that the settings name.
    threads
        Number of threads; results do not depend on it.

    Raises
    ------
    BadRequest
        A setting is invalid.
    DeviceError
        There is no such device, or it does not meet the settings and limits.
    """

    def __init__(
        self,
        settings: Settings | None = None,
        *,
        limits: Limits | None = None,
        trust: TrustLimits | None = None,
        backend: str | None = None,
        threads: int = 1,
    ) -> None:
        self.settings = settings if settings is not None else Settings()
        self.limits = limits if limits is not None else Limits()
        self._trust = trust if trust is not None else TrustLimits()
        self._variant = variant_named(self.settings.variant)
        self._rule = rule_of(self.settings, self._variant, self.limits)
        self._rules = [self._rule]  # one for each stage of an alignment
        if self.settings.mode == "coarse_fine":
            fine, epsilon = replace(VARIANTS["pcl"], stop="step"), self.settings.fine_epsilon
            self._rules.append(replace(self._rule, variant=fine, epsilon=epsilon, line_search=False))
        self._neighbors: Neighbors = self.settings.neighbors or self._variant.neighbors
        if self._neighbors not in ("direct1", "direct7", "radius"):
            raise BadRequest(
                f"unknown neighbour search {self._neighbors!r}", hint="it is direct1, direct7 or radius"
            )
        self._backend: Backend = backend_named(
            self.settings.backend if backend is None else backend,
            self.limits,
            threads,
            self.settings.device,
            fallback=self.settings.fallback,
        )
        if self._backend.max_map_bytes < self.limits.max_map_bytes:
            self.limits = replace(self.limits, map_bytes=self._backend.max_map_bytes)
        self.set_map(VoxelMap({}))

    def close(self) -> None:
        """End the backend's threads."""
        self._backend.close()

    @property
    def backend_name(self) -> str:
        """Name of the backend that computes."""
        return self._backend.name

    @property
    def on_device(self) -> bool:
        """Whether a device does the work, not threads of this process."""
        return self._backend.on_device

    @property
    def fault(self) -> DeviceError | None:
        """Reason why the fallback computes; None while it does not."""
        return self._backend.fault

    @property
    def uploads(self) -> UploadStatistics:
        """Counts of writes of maps to a device; the object is updated in place."""
        return self._backend.uploads

    @property
    def neighbors(self) -> Neighbors:
        """Kind of neighbour search: the voxels that a point is scored against."""
        return self._neighbors

    @property
    def trust(self) -> TrustLimits:
        """Limits that a trusted result must meet, for the map's leaf."""
        return self._trust_in_force

    @property
    def map(self) -> VoxelMap:
        """The map that scans are matched against."""
        return self._map

    def set_map(self, voxel_map: VoxelMap) -> None:
        """Match against this map from now on; takes microseconds if the map is prepared."""
        self._map = voxel_map
        self._trust_in_force = self._trust.for_leaf(voxel_map.leaf, fine=self.settings.mode == "coarse_fine")
        self._backend.set_map(voxel_map)

    def prepare(self, voxel_map: VoxelMap) -> VoxelMap:
        """Compute the tables of a map in advance, so that no alignment waits for them; from any thread."""
        for covariance in dict.fromkeys(rule.variant.covariance for rule in self._rules):
            self._backend.prepare(voxel_map, Scoring(self._neighbors, covariance))
        return voxel_map

    def align(
        self,
        points: NDArray[np.floating],
        T_guess: NDArray[np.floating],
        *,
        regularization: Regularization | None = None,
    ) -> Result:
        """Find the pose of a scan.

        Parameters
        ----------
        points : (N, 3) float32 or float64
            Metres, base frame.
        T_guess : (4, 4)
            Initial guess of ``T_map_base``.
        regularization
            Another estimate that attracts the pose.

        Raises
        ------
        BadRequest
            A shape is wrong, or the guess is not finite.
        DeviceError
            A device failed or did not answer before the deadline, and there is no fallback.
        """
        return self.align_many(points, [T_guess], regularization=regularization)[0]

    def align_many(
        self,
        points: NDArray[np.floating],
        T_guesses: Sequence[NDArray[np.floating]],
        *,
        regularization: Regularization | None = None,
    ) -> list[Result]:
        """Align from several guesses in batches, with the same results as separate alignments.

        Parameters and errors as in `align`; the deadline applies to all guesses together.
        """
        deadline_s = None if self.limits.deadline_s is None else time.monotonic() + self.limits.deadline_s
        guesses = [np.array(T_guess, np.float64) for T_guess in T_guesses]
        if any(guess.shape != (4, 4) or not np.isfinite(guess).all() for guess in guesses):
            raise BadRequest("a guess is a (4, 4) matrix of finite numbers")
        dropped = self._backend.set_source(points)
        used = len(points) - dropped
        alignments: list[list[Ascent]] = [[] for _ in guesses]
        going_on, starts = alignments, guesses
        for rule in self._rules:
            for stages, ascent in zip(
                going_on, self._climb(starts, rule, regularization, deadline_s), strict=True
            ):
                stages.append(ascent)
            going_on = [stages for stages in going_on if stages[-1].last.found and not stages[-1].time_is_up]
            starts = [stages[-1].transforms[-1] for stages in going_on]
        extent = extent_of(points)
        return [self._result(stages, used, dropped, extent) for stages in alignments]

    def evaluate(self, points: NDArray[np.floating], poses: NDArray[np.float64]) -> list[Evaluation]:
        """Score a scan at several pose vectors, (k, 6), without optimization, in batches up to the limit."""
        self._backend.set_source(points)
        variant = self._variant
        return self._evaluate(poses, Scoring(self._neighbors, variant.covariance, variant.pitch_sign))

    def time_bound(self, points: NDArray[np.floating], T: NDArray[np.float64]) -> TimeBound:
        """Predict an upper bound of an alignment's time, from the limits and evaluations of one scan.

        Parameters
        ----------
        points : (N, 3)
            A typical scan.
        T : (4, 4)
            Pose of the scan.
        """
        pose = pose_from_matrix(T)[None, :]
        costs, per_point = [], 1.0
        self.evaluate(points, pose)
        for _ in range(_REPEATS):
            # a device's work is in no thread of this process
            clock = time.perf_counter_ns if self.on_device else time.thread_time_ns
            begin = clock()
            at = self.evaluate(points, pose)[0]
            costs.append(clock() - begin)
            per_point = max(at.neighbours / max(len(points), 1), 1.0)
        used = max(min(len(points), self.limits.source_points), 1)
        max_neighbors = min(self.limits.neighbors, _REACH[self._neighbors] * _SHARED_PLACES)
        # the cost of a point grows at most linearly with its neighbours
        point_ns = min(costs) / used * max(1.0, max_neighbors / per_point)
        steps = self._rule.max_iterations + (2 if self._variant.stop == "step_late" else 0)
        # a line search evaluates the Hessian at its end once more
        evaluations = 1 + steps * (MAX_TRIALS + 2 if self._rule.line_search else 1)
        if self.settings.mode == "coarse_fine":
            evaluations += 1 + self._rule.max_iterations
        return TimeBound(evaluations, self.limits.source_points, point_ns, self.limits.deadline_s)

    def _evaluate(self, poses: NDArray[np.float64], scoring: Scoring) -> list[Evaluation]:
        most = self.limits.poses
        return [
            at
            for first in range(0, len(poses), most)
            for at in self._backend.evaluate(poses[first : first + most], scoring)
        ]

    def _climb(
        self,
        guesses: Sequence[NDArray[np.float64]],
        rule: StepRule,
        regularization: Regularization | None,
        deadline_s: float | None,
    ) -> list[Ascent]:
        """Run the climb from each guess, one after the other."""
        # ndt_omp's line search ends with an evaluation that has the other sign
        scorings = {
            sign: Scoring(self._neighbors, rule.variant.covariance, sign, deadline_s) for sign in (-1.0, 1.0)
        }
        if len(guesses) != 1:
            return self._climb_side_by_side(guesses, rule, scorings, regularization, deadline_s)

        def evaluate(pose: NDArray[np.float64], pitch_sign: float) -> Evaluation:
            at = self._backend.evaluate(pose[None], scorings[pitch_sign])[0]
            return at if regularization is None else regularization.applied(at, pose)

        return [ascend(guesses[0], evaluate, rule, self._backend.step, deadline_s=deadline_s)]

    def _climb_side_by_side(
        self,
        guesses: Sequence[NDArray[np.float64]],
        rule: StepRule,
        scorings: Mapping[float, Scoring],
        regularization: Regularization | None,
        deadline_s: float | None,
    ) -> list[Ascent]:
        """Run the climbs from all guesses together, with the next evaluation of each in one batch."""
        ascents = [started(T_guess) for T_guess in guesses]
        climbs = [climb(ascent, rule, self._backend.step) for ascent in ascents]
        # for each unfinished climb: the next pose and pitch sign to evaluate
        wanted = {number: next(one) for number, one in enumerate(climbs)}
        while wanted:
            found: dict[int, Evaluation] = {}
            for sign, scoring in scorings.items():
                numbers = [number for number, (_, asked) in wanted.items() if asked == sign]
                poses = np.array([wanted[number][0] for number in numbers])
                found |= zip(numbers, self._evaluate(poses, scoring), strict=True)
            for number, at in found.items():
                if regularization is not None:
                    at = regularization.applied(at, wanted[number][0])
                try:
                    wanted[number] = climbs[number].send(at)
                except StopIteration:
                    del wanted[number]
            if deadline_s is not None and time.monotonic() >= deadline_s:
                for number in wanted:
                    ascents[number].time_is_up = True
                break
        return ascents

    def _result(self, stages: Sequence[Ascent], used: int, dropped: int, extent: Extent) -> Result:
        last = stages[-1].last
        transforms = np.array(
            [T for index, stage in enumerate(stages) for T in stage.transforms[1 if index else 0 :]]
        )
        evaluations = [at for stage in stages for at in stage.evaluations]
        points = max(used, 1)
        converged, probability, swings = stages[-1].converged, last.score / points, oscillations(transforms)
        no_map = used > 0 and not last.found
        covariance, leaf = covariance_of(last.hessian), self._map.leaf
        evidence = evidence_of(
            last.hessian,
            covariance,
            extent,
            points=last.found,
            leaf=leaf,
            highest=-gauss_for(leaf).d1,
        )
        return Result(
            T_map_base=transforms[-1],
            iterations=sum(stage.iterations for stage in stages),
            converged=converged,
            transform_probability=probability,
            nvtl=last.nvtl,
            transforms=transforms,
            transform_probabilities=np.array([at.score / points for at in evaluations]),
            nvtls=np.array([at.nvtl for at in evaluations]),
            hessian=last.hessian,
            covariance=covariance,
            oscillations=swings,
            evaluations=len(evaluations),
            evidence=evidence,
            cut=Cut(
                points=dropped,
                neighbor_points=last.cut_points,
                neighbors=last.cut_neighbours,
                voxels=self._map.voxels_left_out,
                map_bytes=self._map.bytes_left_out,
                deadline=any(stage.time_is_up for stage in stages),
            ),
            no_map=no_map,
            failed_limits=self.trust.failed(
                no_map=no_map,
                converged=converged,
                nvtl=last.nvtl,
                transform_probability=probability,
                oscillations=swings,
                evidence=evidence,
            ),
        )

# SPDX-License-Identifier: Apache-2.0
"""`NdtMatcher`: aligns scans with a map of Gaussians."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from types import TracebackType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest
from shmmap_clients.ndt_scan_matcher.backends.backend import Backend, Neighbors
from shmmap_clients.ndt_scan_matcher.backends.fallback_backend import FallbackBackend
from shmmap_clients.ndt_scan_matcher.backends.opencl.errors import DeviceError
from shmmap_clients.ndt_scan_matcher.backends.registry import backend_named
from shmmap_clients.ndt_scan_matcher.backends.uploads import UploadStatistics
from shmmap_clients.ndt_scan_matcher.map.voxel_map import Covariance, VoxelMap
from shmmap_clients.ndt_scan_matcher.matching.evaluation import Evaluation, gauss_for
from shmmap_clients.ndt_scan_matcher.matching.evidence import Extent, evidence_of, extent_of
from shmmap_clients.ndt_scan_matcher.matching.limits import Cut, Limits
from shmmap_clients.ndt_scan_matcher.matching.more_thuente import MAX_TRIALS
from shmmap_clients.ndt_scan_matcher.matching.newton import Ascent, StepRule, climb, started
from shmmap_clients.ndt_scan_matcher.matching.regularization import Regularization
from shmmap_clients.ndt_scan_matcher.matching.result import Result, covariance_of, oscillations
from shmmap_clients.ndt_scan_matcher.matching.settings import Settings, rule_of
from shmmap_clients.ndt_scan_matcher.matching.trust import TrustLimits
from shmmap_clients.ndt_scan_matcher.matching.variants import VARIANTS, Variant, variant_named

__all__ = ["NdtMatcher"]

_REACH: Final = {"direct1": 1, "direct7": 7, "radius": 27}
_SHARED_PLACES: Final = 4  # at a corner of four cells each has its own voxel in one lattice place


class NdtMatcher:
    """Aligns scans with a map; buffers are allocated once, here.

    Parameters
    ----------
    settings
    limits
    trust
        What a result has to reach to be trusted.
    backend
        Another one than the settings name.
    threads
        Results do not depend on it.

    Raises
    ------
    BadRequest
        A setting makes no sense.
    DeviceError
        There is no such device, or it cannot do what settings and limits ask for.
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
        if self._backend.most_map_bytes < self.limits.most_map_bytes:
            self.limits = replace(self.limits, map_bytes=self._backend.most_map_bytes)
        self.set_map(VoxelMap({}))

    def __enter__(self) -> NdtMatcher:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the backend's threads."""
        self._backend.close()

    @property
    def backend_name(self) -> str:
        """Name of what computes."""
        return self._backend.name

    @property
    def on_device(self) -> bool:
        """Whether the work is done elsewhere than in threads of this process."""
        return self._backend.on_device

    @property
    def fault(self) -> DeviceError | None:
        """Why the fallback computes; None as long as it does not."""
        return self._backend.fault if isinstance(self._backend, FallbackBackend) else None

    @property
    def uploads(self) -> UploadStatistics:
        """What was written to a device for maps; it goes on counting."""
        return self._backend.uploads

    @property
    def neighbors(self) -> Neighbors:
        """Which voxels a point is scored against."""
        return self._neighbors

    @property
    def most_neighbors(self) -> int:
        """Voxels that one point can be scored against, at most."""
        return min(self.limits.neighbors, _REACH[self._neighbors] * _SHARED_PLACES)

    @property
    def most_evaluations(self) -> int:
        """Passes over the scan that one alignment can take, at most."""
        steps = self._rule.max_iterations + (2 if self._variant.stop == "step_late" else 0)
        # a line search ends with the Hessian of where it ended
        coarse = 1 + steps * (MAX_TRIALS + 2 if self._rule.line_search else 1)
        fine = 1 + self._rule.max_iterations if self.settings.mode == "coarse_fine" else 0
        return coarse + fine

    @property
    def trust(self) -> TrustLimits:
        """What a result has to reach to be trusted, with the map's leaf."""
        return self._trust_in_force

    @property
    def map(self) -> VoxelMap:
        """What scans are matched against."""
        return self._map

    def set_map(self, voxel_map: VoxelMap) -> None:
        """Match against this map from now on; takes microseconds where its tables are prepared."""
        self._map = voxel_map
        self._trust_in_force = self._trust.for_leaf(voxel_map.leaf, fine=self.settings.mode == "coarse_fine")
        self._backend.set_map(voxel_map)

    def prepare(self, voxel_map: VoxelMap) -> VoxelMap:
        """Compute what alignments will need of a map, so that none of them waits for it; from any thread."""
        covariances: list[Covariance] = [self._variant.covariance]
        if self.settings.mode == "coarse_fine" and "pcl" not in covariances:
            covariances.append("pcl")
        for covariance in covariances:
            self._backend.prepare(voxel_map, neighbors=self._neighbors, covariance=covariance)
        return voxel_map

    def align(
        self,
        points: NDArray[np.floating],
        T_guess: NDArray[np.floating],
        *,
        regularization: Regularization | None = None,
    ) -> Result:
        """Find where a scan was taken.

        Parameters
        ----------
        points : (N, 3) float32 or float64
            Metres, base frame.
        T_guess : (4, 4)
            Where it was probably taken; ``T_map_base``.
        regularization
            Another estimate to be drawn to.

        Raises
        ------
        BadRequest
            Shapes are wrong, or the guess is not finite.
        DeviceError
            A device failed, or had not answered at the deadline, and there is no fallback.
        """
        return self.align_many(points, [T_guess], regularization=regularization)[0]

    def align_many(
        self,
        points: NDArray[np.floating],
        T_guesses: Sequence[NDArray[np.floating]],
        *,
        regularization: Regularization | None = None,
    ) -> list[Result]:
        """Align from several guesses at once: the same results as one after the other, evaluated in batches.

        Parameters and errors are those of `align`; the deadline is that of all together.
        """
        deadline_s = None if self.limits.deadline_s is None else time.monotonic() + self.limits.deadline_s
        guesses = [np.array(T_guess, np.float64) for T_guess in T_guesses]
        if any(guess.shape != (4, 4) or not np.isfinite(guess).all() for guess in guesses):
            raise BadRequest("a guess is a (4, 4) matrix of finite numbers")
        dropped = self._backend.set_source(points)
        used = len(points) - dropped
        coarse = self._climb(guesses, self._rule, regularization, deadline_s)
        ways = [[way] for way in coarse]
        if self.settings.mode == "coarse_fine":
            fine = replace(
                self._rule,
                variant=replace(VARIANTS["pcl"], stop="step"),
                epsilon=self.settings.fine_epsilon,
                line_search=False,
            )
            on = [number for number, way in enumerate(coarse) if way.last.found and not way.time_is_up]
            arrived = [coarse[number].transforms[-1] for number in on]
            for number, way in zip(on, self._climb(arrived, fine, regularization, deadline_s), strict=True):
                ways[number].append(way)
        extent = extent_of(points)
        return [self._result(way, used, dropped, extent) for way in ways]

    def evaluate(self, points: NDArray[np.floating], poses: NDArray[np.float64]) -> list[Evaluation]:
        """Score a scan at several pose vectors, (k, 6), without moving them; in batches of the limit."""
        self._backend.set_source(points)
        found: list[Evaluation] = []
        for first in range(0, len(poses), self.limits.poses):
            found += self._backend.evaluate_many(
                np.asarray(poses[first : first + self.limits.poses], np.float64),
                neighbors=self._neighbors,
                covariance=self._variant.covariance,
                pitch_sign=self._variant.pitch_sign,
            )
        return found

    def _climb(
        self,
        guesses: Sequence[NDArray[np.float64]],
        rule: StepRule,
        regularization: Regularization | None,
        deadline_s: float | None,
    ) -> list[Ascent]:
        """Climb from all guesses side by side."""
        ascents = [started(T_guess) for T_guess in guesses]
        climbs = [climb(ascent, rule, self._step) for ascent in ascents]
        # who still climbs, with the pose and the pitch sign that it wants evaluated next
        wanted = {number: next(one) for number, one in enumerate(climbs)}
        begun = False
        while wanted:
            if begun and deadline_s is not None and time.monotonic() >= deadline_s:
                for number in wanted:
                    ascents[number].time_is_up = True
                break
            begun = True
            for number, at in self._evaluated(wanted, rule.variant, deadline_s):
                pose = wanted[number][0]
                if regularization is not None:
                    at = regularization.applied(at, pose)
                try:
                    wanted[number] = climbs[number].send(at)
                except StopIteration:
                    del wanted[number]
        return ascents

    def _evaluated(
        self, wanted: dict[int, tuple[NDArray[np.float64], float]], variant: Variant, deadline_s: float | None
    ) -> list[tuple[int, Evaluation]]:
        if len(wanted) == 1:
            ((number, (pose, sign)),) = wanted.items()
            at = self._backend.evaluate(
                pose,
                neighbors=self._neighbors,
                covariance=variant.covariance,
                pitch_sign=sign,
                deadline_s=deadline_s,
            )
            return [(number, at)]
        found: list[tuple[int, Evaluation]] = []
        for sign in sorted({sign for _, sign in wanted.values()}):
            numbers = [number for number, (_, one) in wanted.items() if one == sign]
            for first in range(0, len(numbers), self.limits.poses):
                some = numbers[first : first + self.limits.poses]
                evaluations = self._backend.evaluate_many(
                    np.array([wanted[number][0] for number in some]),
                    neighbors=self._neighbors,
                    covariance=variant.covariance,
                    pitch_sign=sign,
                    deadline_s=deadline_s,
                )
                found += zip(some, evaluations, strict=True)
        return found

    def _step(self, at: Evaluation, steady: bool) -> NDArray[np.float64]:
        return self._backend.step(at, steady=steady)

    def _result(self, ways: Sequence[Ascent], used: int, dropped: int, extent: Extent) -> Result:
        last = ways[-1].last
        transforms = np.array(
            [T for index, way in enumerate(ways) for T in way.transforms[1 if index else 0 :]]
        )
        evaluations = [at for way in ways for at in way.evaluations]
        points = max(used, 1)
        converged, probability, swings = ways[-1].converged, last.score / points, oscillations(transforms)
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
            iterations=sum(way.iterations for way in ways),
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
                deadline=any(way.time_is_up for way in ways),
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

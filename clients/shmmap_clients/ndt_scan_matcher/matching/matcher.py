# SPDX-License-Identifier: Apache-2.0
"""`NdtMatcher`: aligns scans with a map of Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest
from shmmap_clients.ndt_scan_matcher.backends.backend import Neighbors
from shmmap_clients.ndt_scan_matcher.backends.registry import backend_named
from shmmap_clients.ndt_scan_matcher.map.voxel_map import VoxelMap
from shmmap_clients.ndt_scan_matcher.matching.evaluation import Evaluation
from shmmap_clients.ndt_scan_matcher.matching.limits import Cut, Limits
from shmmap_clients.ndt_scan_matcher.matching.more_thuente import MAX_TRIALS
from shmmap_clients.ndt_scan_matcher.matching.newton import Ascent, StepRule, ascend
from shmmap_clients.ndt_scan_matcher.matching.regularization import Regularization
from shmmap_clients.ndt_scan_matcher.matching.result import Result, covariance_of, oscillations
from shmmap_clients.ndt_scan_matcher.matching.trust import TrustLimits
from shmmap_clients.ndt_scan_matcher.matching.variants import VARIANTS, Variant, variant_named

__all__ = ["Mode", "NdtMatcher", "Settings"]

Mode = Literal["single", "coarse_fine"]

_REACH: Final = {"direct1": 1, "direct7": 7, "radius": 27}
_SHARED_PLACES: Final = 4  # at a corner of four cells each has its own voxel in one lattice place


@dataclass(frozen=True, slots=True)
class Settings:
    """How to align; what is None is the variant's own default.

    Attributes
    ----------
    variant
        ``"autoware"``, ``"pclomp"`` or ``"pcl"``: covariances, stop rule and neighbours of that program.
    neighbors
        ``"direct1"``, ``"direct7"`` or ``"radius"`` (all voxels whose mean is within one leaf).
    epsilon
        Steps below this end the alignment; metres and radians, and square metres for ``pcl``.
    max_iterations
    step_size
        Longest step, metres and radians.
    line_search
        More-Thuente's line search.
    mode
        ``"coarse_fine"``: when the variant's alignment has ended, continue from there with the voxels' true
        covariances: the wide basin of the one and the accuracy of the other.
    fine_epsilon
        Where the fine part stops.
    steady
        Steps that never swing, see `StepRule`; default: not in ``"single"``, which equals the originals.
    """

    variant: str = "autoware"
    neighbors: Neighbors | None = None
    epsilon: float | None = None
    max_iterations: int | None = None
    step_size: float = 0.1
    line_search: bool | None = None
    mode: Mode = "single"
    fine_epsilon: float = 0.002
    steady: bool | None = None


class NdtMatcher:
    """Aligns scans with a map; buffers are allocated once, here.

    Parameters
    ----------
    settings
    limits
    trust
        What a result has to reach to be trusted.
    backend
        ``"numba"`` or ``"numpy"``.
    threads
        Results do not depend on it.

    Raises
    ------
    BadRequest
        A setting makes no sense.
    """

    def __init__(
        self,
        settings: Settings | None = None,
        *,
        limits: Limits | None = None,
        trust: TrustLimits | None = None,
        backend: str = "numba",
        threads: int = 1,
    ) -> None:
        self.settings = settings if settings is not None else Settings()
        self.limits = limits if limits is not None else Limits()
        self._trust = trust if trust is not None else TrustLimits()
        self._variant = variant_named(self.settings.variant)
        self._rule = _rule(self.settings, self._variant, self.limits)
        self._neighbors: Neighbors = self.settings.neighbors or self._variant.neighbors
        if self._neighbors not in ("direct1", "direct7", "radius"):
            raise BadRequest(
                f"unknown neighbour search {self._neighbors!r}", hint="it is direct1, direct7 or radius"
            )
        self._backend = backend_named(backend, self.limits, threads)
        self._map = VoxelMap({})

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
        return self._trust.for_leaf(self._map.leaf, fine=self.settings.mode == "coarse_fine")

    @property
    def map(self) -> VoxelMap:
        """What scans are matched against."""
        return self._map

    def set_map(self, voxel_map: VoxelMap) -> None:
        """Match against this map from now on; takes microseconds where its tables are prepared."""
        self._map = voxel_map
        self._backend.set_map(voxel_map)

    def prepare(self, voxel_map: VoxelMap) -> VoxelMap:
        """Compute what alignments will need of a map, so that none of them waits for it."""
        voxel_map.table(self._variant.covariance)
        if self.settings.mode == "coarse_fine":
            voxel_map.table("pcl")
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
        """
        guess = np.array(T_guess, np.float64)
        if guess.shape != (4, 4) or not np.isfinite(guess).all():
            raise BadRequest("a guess is a (4, 4) matrix of finite numbers")
        dropped = self._backend.set_source(points)
        used = len(points) - dropped
        way = self._ascend(guess, self._variant, self._rule, regularization)
        ways = [way]
        if self.settings.mode == "coarse_fine" and way.last.found:
            fine = replace(
                self._rule,
                variant=VARIANTS["pcl"],
                epsilon=self.settings.fine_epsilon,
                line_search=False,
            )
            fine = replace(fine, variant=replace(fine.variant, stop="step"))
            ways.append(self._ascend(way.transforms[-1], fine.variant, fine, regularization))
        return self._result(ways, used, dropped)

    def evaluate(self, points: NDArray[np.floating], poses: NDArray[np.float64]) -> list[Evaluation]:
        """Score a scan at several pose vectors, (k, 6), without moving them."""
        self._backend.set_source(points)
        return [self._evaluate(pose, self._variant, None, None) for pose in poses]

    def _ascend(
        self,
        T_guess: NDArray[np.float64],
        variant: Variant,
        rule: StepRule,
        regularization: Regularization | None,
    ) -> Ascent:
        def evaluate(pose: NDArray[np.float64], pitch_sign: float) -> Evaluation:
            return self._evaluate(pose, variant, pitch_sign, regularization)

        return ascend(T_guess, evaluate, rule)

    def _evaluate(
        self,
        pose: NDArray[np.float64],
        variant: Variant,
        pitch_sign: float | None,
        regularization: Regularization | None,
    ) -> Evaluation:
        found = self._backend.evaluate(
            pose,
            neighbors=self._neighbors,
            covariance=variant.covariance,
            pitch_sign=variant.pitch_sign if pitch_sign is None else pitch_sign,
        )
        return found if regularization is None else regularization.applied(found, pose)

    def _result(self, ways: Sequence[Ascent], used: int, dropped: int) -> Result:
        last = ways[-1].last
        transforms = np.array(
            [T for index, way in enumerate(ways) for T in way.transforms[1 if index else 0 :]]
        )
        evaluations = [at for way in ways for at in way.evaluations]
        points = max(used, 1)
        converged, probability, swings = ways[-1].converged, last.score / points, oscillations(transforms)
        no_map = used > 0 and not last.found
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
            covariance=covariance_of(last.hessian),
            oscillations=swings,
            evaluations=len(evaluations),
            cut=Cut(dropped, last.cut_points, last.cut_neighbours, self._map.voxels_left_out),
            no_map=no_map,
            failed_limits=self.trust.failed(
                no_map=no_map,
                converged=converged,
                nvtl=last.nvtl,
                transform_probability=probability,
                oscillations=swings,
            ),
        )


def _rule(settings: Settings, variant: Variant, limits: Limits) -> StepRule:
    epsilon = variant.epsilon if settings.epsilon is None else settings.epsilon
    iterations = variant.max_iterations if settings.max_iterations is None else settings.max_iterations
    if not epsilon > 0 or not settings.step_size > 0 or not settings.fine_epsilon > 0 or iterations < 1:
        raise BadRequest(
            "epsilon, step_size and max_iterations must be positive,"
            f" they are {epsilon}, {settings.step_size} and {iterations}"
        )
    if settings.mode not in ("single", "coarse_fine"):
        raise BadRequest(f"unknown mode {settings.mode!r}", hint="it is single or coarse_fine")
    if limits.iterations is not None:
        iterations = min(iterations, limits.iterations)
    line_search = variant.line_search if settings.line_search is None else settings.line_search
    steady = settings.mode == "coarse_fine" if settings.steady is None else settings.steady
    return StepRule(variant, epsilon, settings.step_size, iterations, line_search, steady)

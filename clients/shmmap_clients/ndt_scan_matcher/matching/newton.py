# SPDX-License-Identifier: Apache-2.0
"""Newton's method on the score: the alignment itself (algorithm 2 of Magnusson 2009).

Three programs differ in it (`VARIANTS`): covariances, stop rule, one sign.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest
from shmmap_clients.ndt_scan_matcher.map.voxel_map import Covariance
from shmmap_clients.ndt_scan_matcher.matching.evaluation import (
    NOTHING,
    Evaluation,
    Neighbors,
    matrix_from_pose,
    pose_from_matrix,
)
from shmmap_clients.ndt_scan_matcher.matching.more_thuente import line_search
from shmmap_clients.ndt_scan_matcher.matching.pose_batch import numpy_step

__all__ = [
    "VARIANTS",
    "Ascent",
    "Step",
    "StepRule",
    "Stop",
    "Variant",
    "ascend",
    "climb",
    "started",
    "variant_named",
]

Stop = Literal["step", "step_late", "squared_translation"]
_BACK: Final = 0.5  # negated cosine between steps of which one goes back on the other
_MAY_LOSE: Final = 0.1  # of the score, by one steady step
Evaluate = Callable[[NDArray[np.float64], float], Evaluation]
Step = Callable[[Evaluation, bool], NDArray[np.float64]]
Climb = Generator[tuple[NDArray[np.float64], float], Evaluation, None]
"""Asks for evaluations, each at a pose vector and with a pitch sign, and gets them."""


@dataclass(frozen=True, slots=True)
class Variant:
    """One program's alignment.

    Attributes
    ----------
    name
    covariance
        How voxels' covariances come from their moments.
    stop
        ``"step"``: the step's 6-norm falls below epsilon, or iterations are up.  ``"step_late"``: the same,
        but never after the first step, and two iterations later.  ``"squared_translation"``: the step's
        translation, squared, is at most epsilon.
    pitch_sign
        Sign in the second derivative after pitch; ndt_omp has the wrong one, but not in the Hessian that
        it computes after a line search.
    line_search
        Whether More-Thuente's line search is the default; else Newton's step is clipped.
    neighbors, epsilon, max_iterations
        Defaults.
    """

    name: str
    covariance: Covariance
    stop: Stop
    pitch_sign: float
    line_search: bool
    neighbors: Neighbors
    epsilon: float
    max_iterations: int


VARIANTS: Final = {
    variant.name: variant
    for variant in (
        # autoware_core 2026-08, multigrid_ndt_omp; defaults of ndt_scan_matcher.param.yaml
        Variant("autoware", "autoware", "step", -1.0, False, "radius", 0.01, 30),
        # koide3/ndt_omp
        Variant("pclomp", "pclomp", "step_late", 1.0, True, "direct7", 0.1, 35),
        # PCL 1.13, pcl::NormalDistributionsTransform
        Variant("pcl", "pcl", "squared_translation", -1.0, True, "radius", 0.1, 35),
    )
}


def variant_named(name: str) -> Variant:
    """Return one of `VARIANTS`; `BadRequest` lists them for another name."""
    if name not in VARIANTS:
        raise BadRequest(f"unknown variant {name!r}", hint=f"variants are: {', '.join(VARIANTS)}")
    return VARIANTS[name]


@dataclass(frozen=True, slots=True)
class StepRule:
    """How far a step goes, and when to stop.

    Attributes
    ----------
    variant
    epsilon
        Metres and radians (the 6-norm of a step), as ``transformation_epsilon``; a step is at least half.
    max_step
        Longest step, the same norm.
    max_iterations
    line_search
        More-Thuente's instead of a clipped Newton step.
    steady
        The originals may swing between two places until iterations are up: where the score is not concave
        they go back along a step that would lead down, and a step across the peak is answered by the same
        one back.  Here curvatures count by their magnitude (saddle-free Newton, Dauphin 2014), so that every
        step sets out upwards.  Steps may end a tenth lower, and so leave small peaks behind, until one goes
        back on the one before, then no lower; instead of others the longest step is halved.
    """

    variant: Variant
    epsilon: float
    max_step: float
    max_iterations: int
    line_search: bool
    steady: bool = False


@dataclass(slots=True)
class Ascent:
    """A climb from the guess to the peak, as far as it has come."""

    pose: NDArray[np.float64]
    transforms: list[NDArray[np.float64]]
    last: Evaluation = NOTHING
    evaluations: list[Evaluation] = field(default_factory=list)
    iterations: int = 0
    converged: bool = False
    time_is_up: bool = False


def started(T_guess: NDArray[np.float64]) -> Ascent:
    """Return an ascent that is still at the guess."""
    return Ascent(pose_from_matrix(T_guess), [T_guess])


def ascend(
    T_guess: NDArray[np.float64],
    evaluate: Evaluate,
    rule: StepRule,
    step_of: Step = numpy_step,
    *,
    deadline_s: float | None = None,
) -> Ascent:
    """Climb from a guess.

    Parameters
    ----------
    T_guess : (4, 4) float64
    evaluate
        Gives an evaluation for a pose vector and a pitch sign.
    rule
    step_of
        Gives the step that an evaluation asks for, steady or not.
    deadline_s
        Of `time.monotonic`: no evaluation but the first begins after it.
    """
    ascent = started(T_guess)
    climbing = climb(ascent, rule, step_of)
    asked = next(climbing)
    with suppress(StopIteration):
        while not ascent.time_is_up:
            asked = climbing.send(evaluate(*asked))
            ascent.time_is_up = deadline_s is not None and time.monotonic() >= deadline_s
    return ascent


def climb(ascent: Ascent, rule: StepRule, step_of: Step = numpy_step) -> Climb:
    """Climb, one evaluation after the other; a caller may run many climbs side by side, or stop."""
    at = yield ascent.pose, rule.variant.pitch_sign
    ascent.last = at
    ascent.evaluations.append(at)
    longest, before, settling = rule.max_step, np.zeros(6), False
    while True:
        step = step_of(at, rule.steady)
        wanted = math.sqrt(step @ step)
        if wanted == 0.0 or wanted != wanted:
            ascent.converged = wanted == 0.0 and at.found > 0
            return
        direction = step / wanted
        if rule.steady and not settling and float(direction @ before) < -_BACK:
            settling, longest = True, longest / 2
        length, direction, reached = yield from _take_step(ascent, at, wanted, direction, rule, longest)
        may_lose = 0.0 if settling else _MAY_LOSE * abs(at.score)
        if rule.steady and reached.score < at.score - may_lose:
            longest = length / 2
        else:
            ascent.pose = ascent.pose + direction * length
            ascent.last = at = reached
            before = direction
            longest = min(2 * longest, rule.max_step)
        ascent.transforms.append(matrix_from_pose(ascent.pose))
        # a steady step may be short because it was cut short: that is not yet the peak
        small = _is_small(ascent.iterations, wanted if rule.steady else length, direction, rule)
        small = small or (rule.steady and longest < rule.epsilon / 2.0)
        ascent.iterations += 1
        if small or _is_last(ascent.iterations, rule):
            ascent.converged = small
            return


def _take_step(
    ascent: Ascent,
    at: Evaluation,
    length: float,
    direction: NDArray[np.float64],
    rule: StepRule,
    longest: float,
) -> Generator[tuple[NDArray[np.float64], float], Evaluation, tuple[float, NDArray[np.float64], Evaluation]]:
    """Return the step's length and direction, and the evaluation where it ends."""
    sign = rule.variant.pitch_sign
    slope = -float(at.gradient @ direction)
    if slope == 0.0:
        return 0.0, direction, at
    if slope > 0.0:  # away from the peak: the Hessian is not negative definite here
        slope, direction = -slope, -direction
    shortest = rule.epsilon / 2.0
    start = ascent.pose
    if not rule.line_search:
        length = max(min(length, longest), shortest)
        latest = yield start + direction * length, sign
        ascent.evaluations.append(latest)
        return length, direction, latest
    search = line_search(length, shortest, longest, -at.score, slope, by_upper_end=rule.variant.name == "pcl")
    trial = next(search)
    while True:
        latest = yield start + direction * trial, sign
        ascent.evaluations.append(latest)
        try:
            trial = search.send((-latest.score, -float(latest.gradient @ direction)))
        except StopIteration as ended:
            length, trials = ended.value
            break
    if trials and sign > 0:
        # ndt_omp computes the Hessian again after a search, and there with the right sign
        latest = yield start + direction * length, -1.0
    return length, direction, latest


def _is_small(iterations_before: int, length: float, direction: NDArray[np.float64], rule: StepRule) -> bool:
    if rule.variant.stop == "squared_translation":
        translation = direction[:3] * length
        return float(translation @ translation) <= rule.epsilon
    if rule.variant.stop == "step_late" and not iterations_before:
        return False
    return abs(length) < rule.epsilon


def _is_last(iterations: int, rule: StepRule) -> bool:
    # ndt_omp compares before it counts, and with "greater than"
    extra = 2 if rule.variant.stop == "step_late" else 0
    return iterations >= rule.max_iterations + extra

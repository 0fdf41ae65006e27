# SPDX-License-Identifier: Apache-2.0
"""Alignment by Newton's method on the score (algorithm 2 of Magnusson 2009).

The variants of three programs (`VARIANTS`) differ in covariances, stop rule and one sign.
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

Stop = Literal["step", "step_late", "squared_translation"]
_BACK: Final = 0.5  # least negated cosine between two opposite steps
_MAY_LOSE: Final = 0.1  # largest relative loss of score in one steady step
Evaluate = Callable[[NDArray[np.float64], float], Evaluation]
Step = Callable[[Evaluation, bool], NDArray[np.float64]]
Climb = Generator[tuple[NDArray[np.float64], float], Evaluation, None]
"""Generator that yields requests, each a pose vector and a pitch sign, and is sent their evaluations."""


@dataclass(frozen=True, slots=True)
class Variant:
    """Rules of one program's alignment.

    Attributes
    ----------
    name
    covariance
        Rule that derives voxels' covariances from their moments.
    stop
        ``"step"``: the step's 6-norm falls below epsilon, or the iteration limit is reached.
        ``"step_late"``: the same, but never after the first step, and with two iterations more.
        ``"squared_translation"``: the step's translation, squared, is at most epsilon.
    pitch_sign
        Sign in the second derivative by pitch.  ndt_omp's is wrong, except in the Hessian after a line
        search.
    line_search
        Whether More-Thuente's line search is the default; else Newton's step is clipped.
    neighbors, epsilon, max_iterations
        Default values of the settings.
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
    """Return one of `VARIANTS`; for any other name, raise `BadRequest` with their list."""
    if name not in VARIANTS:
        raise BadRequest(f"unknown variant {name!r}", hint=f"variants are: {', '.join(VARIANTS)}")
    return VARIANTS[name]


@dataclass(frozen=True, slots=True)
class StepRule:
    """Length of steps, and when to stop.

    Attributes
    ----------
    variant
    epsilon
        Threshold on the 6-norm of a step, metres and radians, as ``transformation_epsilon``; the shortest
        step is half of it.
    max_step
        Longest step, in the same norm.
    max_iterations
    line_search
        Whether to use More-Thuente's line search instead of a clipped Newton step.
    steady
        Whether to prevent oscillation.  The originals may swing between two poses up to the iteration
        limit: where the score is not concave they reverse a step that leads down, and after a step across
        the peak comes the same step back.  A steady step uses the magnitudes of curvatures (saddle-free
        Newton, Dauphin 2014), so that it starts uphill.  It may end a tenth lower, to escape small peaks,
        until a step reverses the one before; from then on no lower.  Else the longest step is halved.
    """

    variant: Variant
    epsilon: float
    max_step: float
    max_iterations: int
    line_search: bool
    steady: bool = False


@dataclass(slots=True)
class Ascent:
    """State of a climb from the guess to the peak."""

    pose: NDArray[np.float64]
    transforms: list[NDArray[np.float64]]
    last: Evaluation = NOTHING
    evaluations: list[Evaluation] = field(default_factory=list)
    iterations: int = 0
    converged: bool = False
    time_is_up: bool = False


def started(T_guess: NDArray[np.float64]) -> Ascent:
    """Return the initial state, at the guess."""
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
        Returns the evaluation of a pose vector with a pitch sign.
    rule
    step_of
        Returns the next step from an evaluation, steady or not.
    deadline_s
        Deadline on `time.monotonic`; only the first evaluation may begin after it.
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
    """Climb, as a generator of evaluations, so that a caller may interleave climbs or stop."""
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
        # a steady step that was cut short does not mean that the peak is reached
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
    """Return the step's length and direction, and the evaluation at its end."""
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
        # after a search, ndt_omp computes the Hessian again, with the right sign
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
    # ndt_omp compares before it increments, and with "greater than"
    extra = 2 if rule.variant.stop == "step_late" else 0
    return iterations >= rule.max_iterations + extra

# SPDX-License-Identifier: Apache-2.0
"""A device against the processor: the same alignments and sums by both, and how far apart they are.

Bounds are those between programs in double precision, and what floats can hold: see `BOUNDS`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, get_args

import numpy as np
from numpy.typing import NDArray

from shmmap_clients.ndt_scan_matcher.backends.backend import Backend, Neighbors
from shmmap_clients.ndt_scan_matcher.backends.device_options import DeviceOptions
from shmmap_clients.ndt_scan_matcher.backends.registry import backend_named
from shmmap_clients.ndt_scan_matcher.device_check.scenes import Case, Scene
from shmmap_clients.ndt_scan_matcher.map.voxel_map import Covariance
from shmmap_clients.ndt_scan_matcher.matching.euler_derivatives import matrix_from_pose
from shmmap_clients.ndt_scan_matcher.matching.evaluation import Evaluation
from shmmap_clients.ndt_scan_matcher.matching.limits import Limits
from shmmap_clients.ndt_scan_matcher.matching.matcher import NdtMatcher
from shmmap_clients.ndt_scan_matcher.matching.result import Result
from shmmap_clients.ndt_scan_matcher.matching.settings import Settings

__all__ = ["BOUNDS", "Bounds", "Check", "check_alignments", "check_evaluations", "check_repeats"]

_REPEATS: Final = 100
_BATCH: Final = 12


@dataclass(frozen=True, slots=True)
class Bounds:
    """How far two results may be apart.

    Attributes
    ----------
    evaluation
        Score, gradient and Hessian of one pose, relative to the largest element.
    t, R, transform_probability
        Of an alignment: metres, elements of the rotation, score per point.
    """

    evaluation: float
    t: float
    R: float
    transform_probability: float


# floats: 2^-24 of 100 m is 6 micrometres for a point, and some thousand points share the error of a pose
BOUNDS: Final = {
    "double": Bounds(1e-12, 1e-9, 1e-9, 1e-9),
    "float": Bounds(2e-4, 1e-4, 2e-5, 2e-3),
}
_TO_ORIGINALS: Final = {
    "double": Bounds(0.0, 1e-4, 1e-5, 1e-4),
    "float": Bounds(0.0, 2e-4, 3e-5, 2.1e-3),
}


@dataclass(frozen=True, slots=True)
class Check:
    """One comparison.

    Attributes
    ----------
    what
        In words.
    equal
        Whether everything was within its bound.
    worst
        The largest difference of each kind.
    failures
        What was not, at most ten lines.
    """

    what: str
    equal: bool
    worst: dict[str, float]
    failures: tuple[str, ...] = ()


def _settings(case: Case, backend: str, device: DeviceOptions) -> Settings:
    return Settings(
        case.variant,
        case.neighbors,  # type: ignore[arg-type]
        case.epsilon,
        case.max_iterations,
        case.step_size,
        mode=case.mode,  # type: ignore[arg-type]
        backend=backend,
        device=device,
    )


def _aligned(scene: Scene, case: Case, backend: str, device: DeviceOptions) -> Result:
    with NdtMatcher(
        _settings(case, backend, device), limits=Limits(source_points=len(scene.scan))
    ) as matcher:
        matcher.set_map(matcher.prepare(scene.voxel_map))
        return matcher.align(scene.scan, matrix_from_pose(np.array(case.guess)))


def check_alignments(scene: Scene, device: DeviceOptions, reference: dict[str, Result]) -> list[Check]:
    """Compare alignments with those of the processor, and with the original program's where it is known.

    Parameters
    ----------
    scene, device
    reference
        Results of the numpy backend by scene and case, which are computed once and kept here.
    """
    bounds = BOUNDS[device.precision]
    there: list[tuple[Case, Result]] = []
    failures: list[str] = []
    worst = {"t_m": 0.0, "R": 0.0, "transform_probability": 0.0}
    for case in scene.cases:
        key = f"{scene.name}: {case.name}, {case.guess}"
        if key not in reference:
            reference[key] = _aligned(scene, case, "numpy", device)
        here, found = reference[key], _aligned(scene, case, "opencl", device)
        there.append((case, found))
        off = _off(found, here.T_map_base, here.transform_probability)
        _note(failures, worst, case.name, off, bounds, found.iterations, here.iterations)
        if found.cut != here.cut:
            failures.append(f"{case.name}: limits left out {found.cut}, not {here.cut}")
    checks = [Check(f"alignments, {scene.name}", not failures, worst, tuple(failures[:10]))]
    known = [(case, found) for case, found in there if case.expected is not None]
    if known:
        failures, worst = [], dict.fromkeys(worst, 0.0)
        for case, found in known:
            assert case.expected is not None  # noqa: S101  # chosen so
            T = np.vstack([case.expected["T"], [0.0, 0.0, 0.0, 1.0]])
            off = _off(found, T, case.expected["transform_probability"])
            most = _TO_ORIGINALS[device.precision]
            _note(failures, worst, case.name, off, most, found.iterations, case.expected["iterations"])
        checks.append(
            Check(f"the original programs, {scene.name}", not failures, worst, tuple(failures[:10]))
        )
    return checks


def _off(found: Result, T: NDArray[np.float64], transform_probability: float) -> dict[str, float]:
    return {
        "t_m": float(np.abs(found.T_map_base[:3, 3] - T[:3, 3]).max()),
        "R": float(np.abs(found.T_map_base[:3, :3] - T[:3, :3]).max()),
        "transform_probability": abs(found.transform_probability - transform_probability),
    }


def _note(
    failures: list[str],
    worst: dict[str, float],
    name: str,
    off: dict[str, float],
    bounds: Bounds,
    iterations: int,
    wanted: int,
) -> None:
    if iterations != wanted:
        failures.append(f"{name}: {iterations} iterations, not {wanted}")
    allowed = {"t_m": bounds.t, "R": bounds.R, "transform_probability": bounds.transform_probability}
    for kind, value in off.items():
        worst[kind] = max(worst[kind], value)
        if not value <= allowed[kind]:
            failures.append(f"{name}: {kind} is {value:.3g} off, {allowed[kind]:g} is allowed")


def _evaluators(scene: Scene, device: DeviceOptions, limits: Limits) -> tuple[Backend, Backend]:
    made = (backend_named("numpy", limits), backend_named("opencl", limits, options=device))
    for one in made:
        one.set_map(scene.voxel_map)
        one.set_source(scene.scan)
    return made


def check_evaluations(scene: Scene, device: DeviceOptions, neighbors_limit: int) -> Check:
    """Compare score, gradient, Hessian and counts by each search and covariance at the scene's guesses."""
    limits = Limits(source_points=len(scene.scan), neighbors=neighbors_limit)
    here, there = _evaluators(scene, device, limits)
    worst, failures = 0.0, []
    poses = sorted({case.guess for case in scene.cases})
    for neighbors in get_args(Neighbors):
        for covariance in get_args(Covariance):
            for pose in map(np.array, poses):
                a = here.evaluate(pose, neighbors=neighbors, covariance=covariance)
                b = there.evaluate(pose, neighbors=neighbors, covariance=covariance)
                off = _relative(b, a)
                worst = max(worst, off)
                if not off <= BOUNDS[device.precision].evaluation:
                    failures.append(f"{neighbors}, {covariance}: {off:.3g} off")
                # where coordinates are floats, a point on a voxel's border may be in the next one
                if device.precision == "double" and _counts(a) != _counts(b):
                    failures.append(f"{neighbors}, {covariance}: counts {_counts(b)}, not {_counts(a)}")
    here.close()
    there.close()
    what = f"evaluations, at most {neighbors_limit} neighbours, {scene.name}"
    return Check(what, not failures, {"relative": worst}, tuple(failures[:10]))


def _relative(found: Evaluation, wanted: Evaluation) -> float:
    offs = [abs(found.score - wanted.score) / max(abs(wanted.score), 1e-300)]
    for a, b in ((found.gradient, wanted.gradient), (found.hessian, wanted.hessian)):
        offs.append(float(np.abs(a - b).max() / max(np.abs(b).max(), 1e-300)))
    return max(offs)


def _counts(at: Evaluation) -> tuple[int, int, int, int]:
    return at.found, at.neighbours, at.cut_points, at.cut_neighbours


def check_repeats(scene: Scene, device: DeviceOptions) -> Check:
    """Compare 100 repeats, and a batch of poses with the poses one by one, bit for bit."""
    limits = Limits(source_points=len(scene.scan))
    there = _evaluators(scene, device, limits)[1]
    pose = np.array(scene.cases[0].guess)
    how: dict[str, Any] = {"neighbors": "radius", "covariance": "autoware"}
    first = there.evaluate(pose, **how)
    unlike = sum(not _same(there.evaluate(pose, **how), first) for _ in range(_REPEATS))
    poses = pose + np.linspace(-1.0, 1.0, _BATCH)[:, None] * np.array([0.5, 0.4, 0.1, 0.01, 0.01, 0.1])
    batch = there.evaluate_many(poses, **how)
    singles: Sequence[Evaluation] = [there.evaluate(one, **how) for one in poses]
    apart = sum(not _same(a, b) for a, b in zip(batch, singles, strict=True))
    there.close()
    failures = []
    if unlike:
        failures.append(f"{unlike} of {_REPEATS} repeats have other bits")
    if apart:
        failures.append(f"{apart} of {_BATCH} poses have other bits in a batch")
    return Check(f"repeats and a batch, {scene.name}", not failures, {}, tuple(failures))


def _same(a: Evaluation, b: Evaluation) -> bool:
    return (
        (a.score, a.nearest, *_counts(a)) == (b.score, b.nearest, *_counts(b))
        and bool((a.gradient == b.gradient).all())
        and bool((a.hessian == b.hessian).all())
    )

# SPDX-License-Identifier: Apache-2.0
"""`Settings`: how to align, and what computes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from shmmap import BadRequest
from shmmap_clients.ndt_scan_matcher.backends.backend import DeviceOptions
from shmmap_clients.ndt_scan_matcher.matching.evaluation import Neighbors
from shmmap_clients.ndt_scan_matcher.matching.limits import Limits
from shmmap_clients.ndt_scan_matcher.matching.newton import StepRule
from shmmap_clients.ndt_scan_matcher.matching.variants import Variant

__all__ = ["Mode", "Settings", "rule_of"]

Mode = Literal["single", "coarse_fine"]


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
    backend
        What computes: ``"numba"``, ``"numpy"`` or ``"opencl"``.
    device
        For backends that compute on a device: which one, and how.
    fallback
        Backend that goes on where a device fails in the middle of the work; None: that is an error.
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
    backend: str = "numba"
    device: DeviceOptions = field(default_factory=DeviceOptions)
    fallback: str | None = None


def rule_of(settings: Settings, variant: Variant, limits: Limits) -> StepRule:
    """Return the rule of an alignment's steps; `BadRequest` where a setting makes no sense."""
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

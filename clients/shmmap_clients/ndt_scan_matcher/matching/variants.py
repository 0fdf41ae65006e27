# SPDX-License-Identifier: Apache-2.0
"""What each of the three NDT programs does its own way: covariances, when to stop, one sign."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

from shmmap import BadRequest
from shmmap_clients.ndt_scan_matcher.map.voxel_map import Covariance
from shmmap_clients.ndt_scan_matcher.matching.evaluation import Neighbors

__all__ = ["VARIANTS", "Stop", "Variant", "variant_named"]

Stop = Literal["step", "step_late", "squared_translation"]


@dataclass(frozen=True, slots=True)
class Variant:
    """One program's way to align.

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

# SPDX-License-Identifier: Apache-2.0
"""Which results are trusted, and which limit the others have failed.

NVTL is at most -d1, which grows with the leaf: 2.22 at 1 m, 4.20 at 2 m, 5.40 at 3 m.  Autoware's threshold
of 2.3 is for its leaf of 2 m, and 0.548 of that.  The same share separates right poses from wrong ones at
other leaf sizes.  True covariances (``coarse_fine``) fit more closely, and score lower below 2 m: there the
share falls to 0.41 at 1 m.

A score alone trusts what a few points, or points within a few metres, fit by chance: `Evidence` bounds that.
Its limits were chosen on parts of recorded and simulated scans; ``python -m tests.benchmarks.ndt_trust`` says
how well they separate right poses from wrong ones.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Final

from shmmap import BadRequest
from shmmap_clients.ndt_scan_matcher.matching.evaluation import gauss_for
from shmmap_clients.ndt_scan_matcher.matching.evidence import FAR_POINTS, Evidence

__all__ = ["TrustLimits", "default_nvtl", "default_sharpness"]

# ndt_scan_matcher.param.yaml of autoware_core: converged_param_nearest_voxel_transformation_likelihood,
# and the oscillations of count_oscillation
_AUTOWARE_NVTL: Final = 2.3
_AUTOWARE_LEAF: Final = 2.0
_MAX_OSCILLATIONS: Final = 10
_SHARE: Final = _AUTOWARE_NVTL / -gauss_for(_AUTOWARE_LEAF).d1
_FINE_SHARE: Final = 0.41  # at a leaf of 1 m and below
_SHARPNESS: Final = 2.7
_FINE_SHARPNESS: Final = 3.4  # true covariances are narrower


def default_nvtl(leaf: float, *, fine: bool = False) -> float:
    """Return the lowest NVTL of a trusted result.

    Parameters
    ----------
    leaf
        Edge of a voxel, metres.
    fine
        Whether the result is one of true covariances (``coarse_fine``).
    """
    share = _SHARE
    if fine and leaf < _AUTOWARE_LEAF:
        share = _FINE_SHARE + (_SHARE - _FINE_SHARE) * max(leaf - 1.0, 0.0)
    return share * -gauss_for(leaf).d1


def default_sharpness(*, fine: bool = False) -> float:
    """Return the lowest sharpness of a trusted result; ``fine`` as in `default_nvtl`."""
    return _FINE_SHARPNESS if fine else _SHARPNESS


@dataclass(frozen=True, slots=True)
class TrustLimits:
    """What a result has to reach to be trusted.

    No score detects every divergence: a pose metres away may reach them all.

    Attributes
    ----------
    nvtl
        Lowest nearest-voxel transformation likelihood; None: `default_nvtl` of the map's leaf.
    transform_probability
        Lowest transform probability; None: any.
    oscillations
        Most reversals of the step.
    points, distance, angle, sharpness, spread
        Least `Evidence`; None for ``sharpness``: `default_sharpness`.
    """

    nvtl: float | None = None
    transform_probability: float | None = None
    oscillations: int = _MAX_OSCILLATIONS
    points: int = 80
    distance: float = 10.0  # required_distance of ndt_scan_matcher.param.yaml
    angle: float = 35.0
    sharpness: float | None = None
    spread: float = 0.03

    def __post_init__(self) -> None:
        for limit in fields(self):
            value = getattr(self, limit.name)
            if value is not None and not value >= 0:
                raise BadRequest(f"a limit of trust must not be negative, {limit.name} is {value}")

    def for_leaf(self, leaf: float, *, fine: bool = False) -> TrustLimits:
        """Return the limits with numbers for ``nvtl`` and ``sharpness``; parameters as in `default_nvtl`."""
        return replace(
            self,
            nvtl=default_nvtl(leaf, fine=fine) if self.nvtl is None else self.nvtl,
            sharpness=default_sharpness(fine=fine) if self.sharpness is None else self.sharpness,
        )

    def failed(
        self,
        *,
        no_map: bool,
        converged: bool,
        nvtl: float,
        transform_probability: float,
        oscillations: int,
        evidence: Evidence,
    ) -> tuple[str, ...]:
        """Return the names of what a result fails, none if it is trusted.

        Returns
        -------
        tuple of str
            ``no_map`` alone, where there was nothing to match; else of ``converged``, ``nvtl``,
            ``transform_probability``, ``oscillations``, ``points``, ``distance``, ``angle``, ``sharpness``,
            ``spread``.
        """
        if no_map:
            return ("no_map",)
        failed = {
            "converged": not converged,
            "nvtl": nvtl < (self.nvtl or 0.0),
            "transform_probability": transform_probability < (self.transform_probability or 0.0),
            "oscillations": oscillations > self.oscillations,
            "points": evidence.points < self.points,
            "distance": evidence.distance < self.distance,
            "angle": evidence.angle < self.angle,
            "sharpness": not evidence.sharpness >= (self.sharpness or 0.0),
            "spread": not evidence.spread >= self.spread,
        }
        return tuple(name for name, fails in failed.items() if fails)

    def describe(self, name: str) -> str:
        """Return in words what it means to fail a limit, as `failed` names it."""
        return {
            "no_map": "no map",
            "converged": "not converged",
            "nvtl": f"NVTL below {self.nvtl or 0.0:.2f}",
            "transform_probability": f"transform probability below {self.transform_probability or 0.0:.2f}",
            "oscillations": f"more than {self.oscillations} oscillations",
            "points": f"fewer than {self.points} points matched",
            "distance": f"fewer than {FAR_POINTS} points beyond {self.distance:g} m",
            "angle": f"all points in a sector of less than {self.angle:g} degrees",
            "sharpness": f"a direction is hardly held (sharpness below {self.sharpness or 0.0:.2f})",
            "spread": f"a direction is held much less than others (spread below {self.spread:.3g})",
        }[name]

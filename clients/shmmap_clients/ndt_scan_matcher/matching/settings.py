# SPDX-License-Identifier: Apache-2.0
"""`Settings`: how to align, and what computes; `Limits`: at most how many points, steps, seconds."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final, Literal

from shmmap import BadRequest
from shmmap_clients.ndt_scan_matcher.backends.backend import DeviceOptions
from shmmap_clients.ndt_scan_matcher.matching.evaluation import Neighbors
from shmmap_clients.ndt_scan_matcher.matching.newton import StepRule, Variant

__all__ = ["VOXEL_BYTES", "Cut", "Limits", "Mode", "Settings", "TimeBound", "rule_of"]

VOXEL_BYTES: Final = 96  # 72 for the Gaussian, the rest for the lattice of a street
_MAX_POSES: Final = 65_536
Mode = Literal["single", "coarse_fine"]


@dataclass(frozen=True, slots=True)
class Limits:
    """Upper bounds that hold for any input; what exceeds one is left out and reported as a `Cut`.

    Attributes
    ----------
    source_points
        Points of a scan; of a larger one every k-th is taken, evenly over the whole scan.
    neighbors
        Voxels that one point is scored against; the nearest are taken.  Inside one cell no search finds
        more than 27.
    voxels
        Gaussians of the map; whole cells are taken, the nearest to the guess first.
    map_bytes
        Of the map's Gaussians and lattices, see `VoxelCell.map_bytes`; whole cells, too.  Sparse cells have
        lattices that are larger than their Gaussians.  `None`: 96 bytes for each voxel that is allowed.
    iterations
        Newton steps; `None` leaves it to the variant.
    poses
        That are evaluated at once; more are evaluated in several batches.
    deadline_s
        Of one alignment, seconds: no evaluation begins after it, and a device that has not answered then is
        not waited for; `None`: none.
    """

    source_points: int = 131_072
    neighbors: int = 32
    voxels: int = 1_000_000
    map_bytes: int | None = None
    iterations: int | None = None
    poses: int = 256
    deadline_s: float | None = None

    def __post_init__(self) -> None:
        for name in ("source_points", "neighbors", "voxels", "poses", "map_bytes", "iterations"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise BadRequest(f"the limit on {name} must be positive, it is {value}")
        if self.poses > _MAX_POSES:
            raise BadRequest(f"at most {_MAX_POSES} poses can be evaluated at once, not {self.poses}")
        if self.deadline_s is not None and not 0.0 < self.deadline_s < math.inf:
            raise BadRequest(f"a deadline must be a positive number of seconds, it is {self.deadline_s}")

    @property
    def max_map_bytes(self) -> int:
        """The limit ``map_bytes``, or what stands for it."""
        return VOXEL_BYTES * self.voxels if self.map_bytes is None else self.map_bytes


@dataclass(frozen=True, slots=True)
class Cut:
    """What the limits left out of one alignment.

    Attributes
    ----------
    points
        Points of the scan that were not used.
    neighbor_points, neighbors
        In the last evaluation: points with more neighbours than the limit, and those neighbours.
    voxels, map_bytes
        Gaussians of cells that were left out of the map, and what those would have taken.
    deadline
        Whether time was up before the alignment had ended.
    """

    points: int = 0
    neighbor_points: int = 0
    neighbors: int = 0
    voxels: int = 0
    map_bytes: int = 0
    deadline: bool = False

    @property
    def by(self) -> tuple[str, ...]:
        """Names of the limits that left something out; a cell left out counts for both of its limits."""
        left = {
            "points": self.points,
            "neighbors": self.neighbor_points,
            "voxels": self.voxels,
            "map_bytes": self.map_bytes,
            "deadline": self.deadline,
        }
        return tuple(name for name, count in left.items() if count)

    def __bool__(self) -> bool:
        return bool(self.by)


@dataclass(frozen=True, slots=True)
class TimeBound:
    """A bound of the time of one alignment on this machine.

    Attributes
    ----------
    evaluations
        Passes over the scan, at most.
    points
        Of a scan, at most.
    point_ns
        Time of one point in one pass, measured on the given scan, scaled up to as many neighbours as the
        limit allows: processor time where this thread computes, else, on a device, time that passes.
    deadline_s
        The limit on one alignment's time; None: none.
    """

    evaluations: int
    points: int
    point_ns: float
    deadline_s: float | None = None

    @property
    def pass_ms(self) -> float:
        """The bound of one pass, milliseconds."""
        return self.points * self.point_ns * 1e-6

    @property
    def total_ms(self) -> float:
        """The bound, milliseconds on one thread that has a processor for itself, or on the device."""
        most = self.evaluations * self.pass_ms
        # a pass that has begun before the deadline is finished
        return most if self.deadline_s is None else min(most, self.deadline_s * 1e3 + self.pass_ms)

    def describe(self) -> str:
        """Return the bound with what it is made of."""
        return (
            f"worst case for the largest scan allowed: {self.total_ms / 1e3:.1f} s"
            f" ({self.points} points x {self.evaluations} evaluations x {self.point_ns:.0f} ns"
            f"{'' if self.deadline_s is None else f', or {self.deadline_s:g} s and one evaluation'}); a lower"
            " --max-points lowers it"
        )


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

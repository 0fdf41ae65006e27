# SPDX-License-Identifier: Apache-2.0
"""`Settings`: method and backend of alignments; `Limits`: upper bounds of points, steps and time."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final, Literal

from shmmap import BadRequest
from shmmap_clients.ndt_scan_matcher.backends.backend import DeviceOptions
from shmmap_clients.ndt_scan_matcher.matching.evaluation import Neighbors
from shmmap_clients.ndt_scan_matcher.matching.newton import StepRule, Variant

VOXEL_BYTES: Final = 96  # 72 for the Gaussian, the rest for the lattice of a street
_MAX_POSES: Final = 65_536
Mode = Literal["single", "coarse_fine"]


@dataclass(frozen=True, slots=True)
class Limits:
    """Upper bounds that hold for any input; items above a limit are left out and reported as a `Cut`.

    Attributes
    ----------
    source_points
        Points of a scan; of a larger scan every k-th point is taken, evenly over the whole scan.
    neighbors
        Voxels that one point is scored against; the nearest are taken.  Within one cell, any search finds
        at most 27.
    voxels
        Gaussians of the map; whole cells are taken, the nearest to the guess first.
    map_bytes
        Size of the map's Gaussians and lattices, see `VoxelCell.map_bytes`; also in whole cells.  The
        lattice of a sparse cell is larger than its Gaussians.  `None`: 96 bytes for each allowed voxel.
    iterations
        Newton steps; `None`: the variant's default.
    poses
        Poses in one batch; more poses are evaluated in several batches.
    deadline_s
        Time of one alignment, seconds: no evaluation begins later, and waiting for a device ends then.
        `None`: no deadline.
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
        """The limit ``map_bytes``, or its default."""
        return VOXEL_BYTES * self.voxels if self.map_bytes is None else self.map_bytes


@dataclass(frozen=True, slots=True)
class Cut:
    """Items that the limits left out of one alignment.

    Attributes
    ----------
    points
        Points of the scan that were not used.
    neighbor_points, neighbors
        In the last evaluation: points with more neighbours than the limit, and those neighbours.
    voxels, map_bytes
        Gaussians of cells left out of the map, and their size.
    deadline
        Whether the deadline passed before the alignment ended.
    """

    points: int = 0
    neighbor_points: int = 0
    neighbors: int = 0
    voxels: int = 0
    map_bytes: int = 0
    deadline: bool = False

    @property
    def by(self) -> tuple[str, ...]:
        """Names of the limits that left something out; an omitted cell counts for both of its limits."""
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
    """Upper bound of the time of one alignment on this machine.

    Attributes
    ----------
    evaluations
        Largest number of passes over the scan.
    points
        Largest number of points of a scan.
    point_ns
        Time of one point in one pass, measured on the given scan, scaled to the largest allowed number of
        neighbours.  Processor time if this thread computes, wall-clock time on a device.
    deadline_s
        The limit on one alignment's time; None: no limit.
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
        """The bound, milliseconds, for one thread with its own processor, or for the device."""
        most = self.evaluations * self.pass_ms
        # a pass that begins before the deadline runs to its end
        return most if self.deadline_s is None else min(most, self.deadline_s * 1e3 + self.pass_ms)

    def describe(self) -> str:
        """Return the bound with its factors, as text."""
        return (
            f"worst case for the largest scan allowed: {self.total_ms / 1e3:.1f} s"
            f" ({self.points} points x {self.evaluations} evaluations x {self.point_ns:.0f} ns"
            f"{'' if self.deadline_s is None else f', or {self.deadline_s:g} s and one evaluation'}); a lower"
            " --max-points lowers it"
        )


@dataclass(frozen=True, slots=True)
class Settings:
    """Method of alignments; None means the variant's default.

    Attributes
    ----------
    variant
        ``"autoware"``, ``"pclomp"`` or ``"pcl"``: covariances, stop rule and neighbours of this program.
    neighbors
        ``"direct1"``, ``"direct7"`` or ``"radius"`` (all voxels whose mean is within one leaf).
    epsilon
        A step below this ends the alignment; metres and radians, for ``pcl`` square metres.
    max_iterations
    step_size
        Longest step, metres and radians.
    line_search
        Whether to use More-Thuente's line search.
    mode
        ``"coarse_fine"``: after the variant's alignment, continue with the voxels' true covariances.  This
        combines a wide basin of convergence with accuracy.
    fine_epsilon
        As ``epsilon``, for the fine stage.
    steady
        Whether to prevent oscillation, see `StepRule`; by default off in ``"single"``, as in the originals.
    backend
        Backend that computes: ``"numba"``, ``"numpy"`` or ``"opencl"``.
    device
        Options of backends that compute on a device.
    fallback
        Backend that takes over if a device fails during an alignment; None: raise the error.
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
    """Return the step rule of an alignment; raise `BadRequest` if a setting is invalid."""
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

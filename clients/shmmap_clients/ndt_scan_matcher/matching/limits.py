# SPDX-License-Identifier: Apache-2.0
"""Upper limits of one alignment: points, neighbours, the map, iterations, poses at once, time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from shmmap import BadRequest

__all__ = ["VOXEL_BYTES", "Cut", "Limits"]

VOXEL_BYTES: Final = 96  # 72 for the Gaussian, the rest for the lattice of a street
_MOST_POSES: Final = 65_536


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
        if self.poses > _MOST_POSES:
            raise BadRequest(f"at most {_MOST_POSES} poses can be evaluated at once, not {self.poses}")
        if self.deadline_s is not None and not 0.0 < self.deadline_s < math.inf:
            raise BadRequest(f"a deadline must be a positive number of seconds, it is {self.deadline_s}")

    @property
    def most_map_bytes(self) -> int:
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

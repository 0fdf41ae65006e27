# SPDX-License-Identifier: Apache-2.0
"""Upper limits of one alignment: points, neighbours, voxels, iterations."""

from __future__ import annotations

from dataclasses import dataclass

from shmmap import BadRequest

__all__ = ["Cut", "Limits"]


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
    iterations
        Newton steps; `None` leaves it to the variant.
    """

    source_points: int = 131_072
    neighbors: int = 32
    voxels: int = 1_000_000
    iterations: int | None = None

    def __post_init__(self) -> None:
        for name in ("source_points", "neighbors", "voxels"):
            if getattr(self, name) < 1:
                raise BadRequest(f"the limit on {name} must be positive, it is {getattr(self, name)}")
        if self.iterations is not None and self.iterations < 1:
            raise BadRequest(f"the limit on iterations must be positive, it is {self.iterations}")


@dataclass(frozen=True, slots=True)
class Cut:
    """What the limits left out of one alignment.

    Attributes
    ----------
    points
        Points of the scan that were not used.
    neighbor_points, neighbors
        In the last evaluation: points with more neighbours than the limit, and those neighbours.
    voxels
        Gaussians of cells that were left out of the map.
    """

    points: int = 0
    neighbor_points: int = 0
    neighbors: int = 0
    voxels: int = 0

    def __bool__(self) -> bool:
        return bool(self.points or self.neighbor_points or self.voxels)

# SPDX-License-Identifier: Apache-2.0
"""What the height of a column is."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Final

from shmmap import BadRequest

__all__ = ["RULES", "ElevationRule"]

RULES: Final = ("surface", "min", "mean", "max")


@dataclass(frozen=True, slots=True)
class ElevationRule:
    """How columns are made of points.

    ``surface`` is what Autoware's elevation_map_loader has grid_map_pcl do (``height_type`` 1): the points
    of a column fall into clusters, whose neighbouring points are no farther apart than ``tolerance``;
    of the clusters of at least ``min_points`` whose mean height is at most ``height_range`` above the
    lowest such mean, the one of most points gives its mean height (of equal ones the lowest).  It needs the
    points.  On a slope it is off by as much as the points' middle is beside the column's: with n points
    about 0.3 · resolution · slope / sqrt(n).  ``min``, ``mean`` and ``max`` are those of all points of the
    column; the ``elevation`` layer has them.

    Attributes
    ----------
    name
        ``surface``, ``min``, ``mean`` or ``max``.
    resolution
        Edge of a column, metres; column (i, j) reaches from i · resolution to (i + 1) · resolution.
    tolerance, height_range
        Metres.
    min_points
        Of a column, and of a cluster.

    Raises
    ------
    BadRequest
        A value makes no sense.
    """

    name: str = "surface"
    resolution: float = 0.3
    tolerance: float = 0.2
    height_range: float = 1.0
    min_points: int = 3

    def __post_init__(self) -> None:
        if self.name not in RULES:
            raise BadRequest(
                f"elevation rule {self.name!r} is unknown", hint=f"use one of {', '.join(RULES)}"
            )
        for what in ("resolution", "tolerance", "height_range"):
            value: float = getattr(self, what)
            if not (math.isfinite(value) and value > 0):
                raise BadRequest(f"{what} must be positive, not {value!r} m")
        if self.min_points < 1:
            raise BadRequest(f"min_points must be at least 1, not {self.min_points}")

    @property
    def layer(self) -> str:
        """Layer that the rule is answered from."""
        return "points" if self.name == "surface" else f"elevation(resolution={float(self.resolution)!r})"

    @property
    def document(self) -> dict[str, Any]:
        """The rule as JSON."""
        return asdict(self)

# SPDX-License-Identifier: Apache-2.0
"""A pose as programs give it, made into what travels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import chain
from typing import TYPE_CHECKING, Any

from shmmap.errors import BadRequest
from shmmap.protocol.messages import Intent

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["pose_intent"]


def pose_intent(
    x: float,
    y: float,
    vx: float,
    vy: float,
    heading: float | None,
    route: Sequence[tuple[float, float]] | NDArray[Any],
) -> Intent:
    """Return a pose as it travels, whatever kind of numbers it came in; see `shmmap.MapWindow.move_to`.

    Raises
    ------
    BadRequest
        A number is missing, is none, or is not finite.
    """
    try:
        path = tuple([(float(route_x), float(route_y)) for route_x, route_y in route])
        angle = None if heading is None else float(heading)
        pose = Intent(float(x), float(y), float(vx), float(vy), angle, path)
    except (TypeError, ValueError) as error:
        raise BadRequest(f"pose: numbers are needed, and two for each point of a route: {error}") from error
    if not all(map(math.isfinite, (pose.x, pose.y, pose.vx, pose.vy, angle or 0.0, *chain(*path)))):
        raise BadRequest("pose: every number in it must be finite")
    return pose

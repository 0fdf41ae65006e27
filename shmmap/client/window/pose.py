# SPDX-License-Identifier: Apache-2.0
"""A pose as programs give it, made into what travels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from shmmap.client.route import thinned
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
        path = np.array(route if isinstance(route, np.ndarray) else list(route), dtype=np.float64)
        if path.size and (path.ndim != 2 or path.shape[1] != 2):
            raise ValueError(f"the route's shape is {path.shape}")
        angle = None if heading is None else float(heading)
        pose = Intent(float(x), float(y), float(vx), float(vy), angle)
    except (TypeError, ValueError) as error:
        raise BadRequest(f"pose: numbers are needed, and two for each point of a route: {error}") from None
    numbers_finite = all(map(math.isfinite, (pose.x, pose.y, pose.vx, pose.vy, angle or 0.0)))
    if not numbers_finite or not np.isfinite(path).all():
        raise BadRequest("pose: every number in it must be finite")
    if path.size:
        pose = msgspec.structs.replace(pose, route=tuple(map(tuple, thinned(path).tolist())))
    return pose

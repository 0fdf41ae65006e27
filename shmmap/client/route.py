# SPDX-License-Identifier: Apache-2.0
"""A route of any length, made into one that travels with every request."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np

from shmmap.errors import BadRequest
from shmmap.protocol.messages import Intent

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["MOST_PLACES", "sendable", "thinned"]

MOST_PLACES: Final = 512
"""The daemon keeps no more: of a longer route so many places are sent, equally far apart along it."""
FARTHEST_M: Final = 1e8
"""Coordinates beyond this count as this, as in the daemon."""


def thinned(route: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a route of at most `MOST_PLACES` places.

    Parameters
    ----------
    route
        (N, 2), metres, map frame, finite.

    Returns
    -------
    NDArray
        The route itself where it is no longer than that; else places equally far apart along it, its ends
        among them.
    """
    if len(route) <= MOST_PLACES:
        return route
    route = route.clip(-FARTHEST_M, FARTHEST_M)
    steps = np.diff(route, axis=0)
    along = np.concatenate(([0.0], np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))))
    if not along[-1]:
        return route[:1]
    places = np.linspace(0.0, along[-1], MOST_PLACES)
    return np.stack([np.interp(places, along, route[:, 0]), np.interp(places, along, route[:, 1])], axis=-1)


def sendable(intent: Intent | None) -> Intent | None:
    """Return an intent whose route is short enough to be sent.

    Raises
    ------
    BadRequest
        A place of a long route is not two finite numbers.
    """
    if intent is not None and not isinstance(intent, Intent):
        raise BadRequest(f"intent must be an Intent, not {intent!r}")
    if intent is None or len(intent.route) <= MOST_PLACES:
        return intent
    try:
        route = np.array(intent.route, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise BadRequest(f"route: two numbers are needed for each place: {error}") from None
    if route.ndim != 2 or route.shape[1] != 2 or not np.isfinite(route).all():
        raise BadRequest("route: each place is two finite numbers")
    return msgspec.structs.replace(intent, route=tuple(map(tuple, thinned(route).tolist())))

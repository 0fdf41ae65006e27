# SPDX-License-Identifier: Apache-2.0
"""Arguments of programs, checked before anything is done with them; what makes no sense is a `BadRequest`.

Numbers, names, heights, and where a vehicle is and goes: a pose in whatever numbers it comes, and a route of
any length, become an `Intent` that can be sent.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Iterable, Sequence
from threading import TIMEOUT_MAX
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

import shmmap.geometry as geometry
from shmmap.errors import BadRequest
from shmmap.protocol.messages import Intent

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = [
    "MAX_ROUTE_PLACES",
    "checked_intent",
    "checked_seconds",
    "heights",
    "names",
    "number",
    "pose_intent",
    "thinned",
    "timeout_s",
]

MAX_ROUTE_PLACES: Final = 512
"""The daemon keeps no more: of a longer route this many places are sent, equally far apart along it."""
FARTHEST_M: Final = 1e8
"""Coordinates beyond this count as this, as in the daemon."""


def number(what: str, value: float, *, unit: str = "seconds", positive: bool = False) -> float:
    """Return a number that is not negative; infinity is one.

    Raises
    ------
    BadRequest
        It is none.
    """
    try:
        given = float(value)
    except (TypeError, ValueError, OverflowError):
        given = math.nan
    if not (given > 0 if positive else given >= 0):
        kind = "a positive number of" if positive else "a number of"
        raise BadRequest(f"{what} must be {kind} {unit}, not {value!r}")
    return given


def timeout_s(what: str, value: float) -> float:
    """Return seconds that something may take: more than none, and no more than can be waited for."""
    given = number(what, value, positive=True)
    if given > TIMEOUT_MAX:
        raise BadRequest(f"{what} must be at most {TIMEOUT_MAX:.0f} seconds, not {value!r}")
    return given


def checked_seconds(what: str, seconds: object) -> float:
    """Return a time that can be waited for, 0 included.

    Raises
    ------
    BadRequest
        It is no number, negative, or longer than can be waited for.
    """
    if not isinstance(seconds, numbers.Real) or not 0 <= float(seconds) <= TIMEOUT_MAX:  # nor NaN
        raise BadRequest(f"{what} must be a number of seconds, 0 or more, not {seconds!r}")
    return float(seconds)


def names(what: str, given: str | Iterable[str]) -> tuple[str, ...]:
    """Return ids or layers as a tuple; one alone counts as one."""
    if isinstance(given, str):
        return (given,)
    try:
        found = tuple(given)
    except TypeError:
        raise BadRequest(f"{what} must be names, not {given!r}") from None
    for one in found:
        if not isinstance(one, str):
            raise BadRequest(f"{what} must be names, and {one!r} is none")
    return found


def heights(z: tuple[float, float] | None) -> geometry.ZRange | None:
    """Return heights of interest, (lowest, highest) in metres; None: all."""
    if z is None or isinstance(z, geometry.ZRange):
        return z
    try:
        lowest, highest = z
    except (TypeError, ValueError):
        raise BadRequest(f"z must be (lowest, highest) in metres, not {z!r}") from None
    return geometry.ZRange(lowest, highest)


# --- where a vehicle is and goes ------------------------------------------------------------------


def pose_intent(
    x: float,
    y: float,
    vx: float,
    vy: float,
    heading: float | None,
    route: Sequence[tuple[float, float]] | NDArray[Any],
) -> Intent:
    """Return a pose as it is sent, whatever kind of numbers it came in; see `shmmap.MapWindow.move_to`.

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
    return _with_route(pose, path) if path.size else pose


def checked_intent(intent: Intent | None) -> Intent | None:
    """Return an intent whose route is short enough to be sent.

    Raises
    ------
    BadRequest
        It is none, or a place of a long route is not two finite numbers.
    """
    if intent is not None and not isinstance(intent, Intent):
        raise BadRequest(f"intent must be an Intent, not {intent!r}")
    if intent is None or len(intent.route) <= MAX_ROUTE_PLACES:
        return intent
    try:
        route = np.array(intent.route, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise BadRequest(f"route: two numbers are needed for each place: {error}") from None
    if route.ndim != 2 or route.shape[1] != 2 or not np.isfinite(route).all():
        raise BadRequest("route: each place is two finite numbers")
    return _with_route(intent, route)


def thinned(route: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a route of at most `MAX_ROUTE_PLACES` places.

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
    if len(route) <= MAX_ROUTE_PLACES:
        return route
    route = route.clip(-FARTHEST_M, FARTHEST_M)
    steps = np.diff(route, axis=0)
    along = np.concatenate(([0.0], np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))))
    if not along[-1]:
        return route[:1]
    places = np.linspace(0.0, along[-1], MAX_ROUTE_PLACES)
    return np.stack([np.interp(places, along, route[:, 0]), np.interp(places, along, route[:, 1])], axis=-1)


def _with_route(intent: Intent, route: NDArray[np.float64]) -> Intent:
    return msgspec.structs.replace(intent, route=tuple(map(tuple, thinned(route).tolist())))

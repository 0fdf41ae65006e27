# SPDX-License-Identifier: Apache-2.0
"""Checks of the arguments that programs pass; an invalid argument raises `BadRequest`.

Covers numbers, names, heights, poses and routes.  A pose of any numeric type and a route of any length become
an `Intent`, ready to send.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Iterable, Iterator, Sequence
from threading import TIMEOUT_MAX
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from shmmap.errors import BadRequest
from shmmap.protocol.messages import Intent

if TYPE_CHECKING:
    from numpy.typing import NDArray

MAX_ROUTE_PLACES: Final = 512
"""Most places of a route that the daemon keeps; a longer route is resampled to this many, equally spaced."""
MAX_WAIT_S: Final = 60.0
"""Longest wait of one request: a daemon that hangs is noticed even while a program waits longer for cells."""
FARTHEST_M: Final = 1e8
"""Coordinates beyond this limit are clamped to it, as in the daemon."""


def number(what: str, value: float, *, unit: str = "seconds", positive: bool = False) -> float:
    """Return a checked number: not negative, possibly infinite.

    Raises
    ------
    BadRequest
        The value is not such a number.
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
    """Return a checked timeout in seconds: positive, at most the longest wait that Python supports."""
    given = number(what, value, positive=True)
    if given > TIMEOUT_MAX:
        raise BadRequest(f"{what} must be at most {TIMEOUT_MAX:.0f} seconds, not {value!r}")
    return given


def checked_seconds(seconds: object) -> float:
    """Return a checked ``timeout_s``; 0 is allowed.

    Raises
    ------
    BadRequest
        The value is no number, is negative, or is longer than Python can wait.
    """
    if not isinstance(seconds, numbers.Real) or not 0 <= float(seconds) <= TIMEOUT_MAX:  # nor NaN
        raise BadRequest(f"timeout_s must be a number of seconds, 0 or more, not {seconds!r}")
    return float(seconds)


def names(what: str, given: str | Iterable[str]) -> tuple[str, ...]:
    """Return ids or layers as a tuple; a single string becomes a tuple of one."""
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


def request_waits(wait: float | None) -> Iterator[float | None]:
    """Split a long wait for cells: yield the seconds that each successive request may wait.

    Raises
    ------
    BadRequest
        ``wait`` is no number of seconds, or is negative.
    """
    left_s = None if wait is None else number("wait", wait)
    while left_s is not None and left_s > MAX_WAIT_S:
        yield MAX_WAIT_S
        left_s -= MAX_WAIT_S
    yield left_s


# --- pose and route of a vehicle ------------------------------------------------------------------


def pose_intent(
    x: float,
    y: float,
    vx: float,
    vy: float,
    heading: float | None,
    route: Sequence[tuple[float, float]] | NDArray[Any],
) -> Intent:
    """Return a pose of any numeric type as an `Intent` to send; see `shmmap.MapWindow.move_to`.

    Raises
    ------
    BadRequest
        A value is missing, is not a number, or is not finite.
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
    places = tuple(map(tuple, thinned(path).tolist())) if path.size else ()
    return msgspec.structs.replace(pose, route=places)


def given_intent(
    pose: Sequence[float] | None,
    velocity: Sequence[float],
    heading: float | None,
    route: Sequence[tuple[float, float]] | NDArray[Any],
) -> Intent | None:
    """Return the pose and route given to `shmmap.Client.area` as an `Intent`; None if no pose is given.

    Raises
    ------
    BadRequest
        There is a velocity, a heading or a route without a pose, or one of them is invalid.
    """
    if pose is None:
        if heading is not None or len(route) or tuple(velocity) != (0.0, 0.0):
            raise BadRequest("velocity, heading and route need a pose", hint="give pose=(x, y), too")
        return None
    try:
        (x, y), (vx, vy) = pose, velocity
    except (TypeError, ValueError):
        raise BadRequest(
            f"pose and velocity are two numbers each, (x, y), not {pose!r} and {velocity!r}"
        ) from None
    return pose_intent(x, y, vx, vy, heading, route)


def thinned(route: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a route of at most `MAX_ROUTE_PLACES` places.

    Parameters
    ----------
    route
        (N, 2), metres, map frame, finite.

    Returns
    -------
    NDArray
        The route itself if it has no more places; else equally spaced places along it, both ends included.
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

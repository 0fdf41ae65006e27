# SPDX-License-Identifier: Apache-2.0
"""Arguments of programs, checked before anything is done with them; what makes no sense is a `BadRequest`."""

from __future__ import annotations

import math
from collections.abc import Iterable
from threading import TIMEOUT_MAX

from shmmap import geometry
from shmmap.errors import BadRequest

__all__ = ["heights", "names", "number", "timeout_s"]


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

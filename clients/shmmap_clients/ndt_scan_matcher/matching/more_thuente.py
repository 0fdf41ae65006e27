# SPDX-License-Identifier: Apache-2.0
"""The line search of More and Thuente (1994) as PCL and ndt_omp have it, to the letter.

Where the originals divide by zero they continue with an infinity or a NaN; so does this.  They differ in one
case, see `search_step`.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Final

import numpy as np

__all__ = ["MAX_TRIALS", "line_search", "search_step"]

MAX_TRIALS: Final = 10
Search = Generator[float, tuple[float, float], tuple[float, int]]
_MU: Final = 1e-4  # sufficient decrease, eq. 1.1
_NU: Final = 0.9  # curvature, eq. 1.2


@dataclass(slots=True)
class _Point:
    """A step length, the function's value there, and its slope."""

    a: np.float64
    f: np.float64
    g: np.float64


def search_step(
    first: float,
    step_min: float,
    step_max: float,
    phi_0: float,
    slope_0: float,
    phi: Callable[[float], tuple[float, float]],
    *,
    by_upper_end: bool,
) -> tuple[float, int]:
    """Return a step length along a descent direction, and how many trials it took after the first.

    Parameters
    ----------
    first
        Newton's own step length.
    step_min, step_max
        Bounds of the step length; without room between them the first is taken.
    phi_0, slope_0
        The negated score and its slope at the start; the slope is negative.
    phi
        The same at a step length.
    by_upper_end
        Where the last trial has become the lower end: PCL 1.13 takes the cubic through the upper end,
        ndt_omp divides by zero.
    """
    search = line_search(first, step_min, step_max, phi_0, slope_0, by_upper_end=by_upper_end)
    a = next(search)
    try:
        while True:
            a = search.send(phi(a))
    except StopIteration as ended:
        found: tuple[float, int] = ended.value
        return found


def line_search(
    first: float,
    step_min: float,
    step_max: float,
    phi_0: float,
    slope_0: float,
    *,
    by_upper_end: bool,
) -> Search:
    """Search as `search_step`, for who has value and slope of each trial only later: yields the trials."""
    search = _search(first, step_min, step_max, np.float64(phi_0), np.float64(slope_0), by_upper_end)
    with np.errstate(all="ignore"):
        trial = next(search)
    while True:
        value_and_slope = yield trial
        try:
            with np.errstate(all="ignore"):
                trial = search.send(value_and_slope)
        except StopIteration as ended:
            found: tuple[float, int] = ended.value
            return found


def _search(
    first: float,
    step_min: float,
    step_max: float,
    phi_0: np.float64,
    slope_0: np.float64,
    by_upper_end: bool,
) -> Search:
    zero = np.float64(0.0)
    # psi(a) = phi(a) - phi(0) - mu phi'(0) a, eq. 2.1
    low = _Point(zero, zero, slope_0 - _MU * slope_0)
    high = _Point(zero, zero, slope_0 - _MU * slope_0)
    converged, opened = step_max - step_min < 0, True
    a = np.float64(_clip(first, step_min, step_max))
    value, slope = yield float(a)
    at_phi = _Point(a, np.float64(value), np.float64(slope))
    at_psi = _psi(at_phi, phi_0, slope_0)
    trials = 0
    while not converged and trials < MAX_TRIALS and not (at_psi.f <= 0 and at_phi.g <= -_NU * slope_0):
        a = np.float64(
            _clip(_trial(low, high, at_psi if opened else at_phi, by_upper_end), step_min, step_max)
        )
        value, slope = yield float(a)
        at_phi = _Point(a, np.float64(value), np.float64(slope))
        at_psi = _psi(at_phi, phi_0, slope_0)
        if opened and at_psi.f <= 0 and at_psi.g >= 0:
            opened = False
            for end in (low, high):
                # the sign before mu is that of the originals
                end.f = end.f + phi_0 - _MU * slope_0 * end.a
                end.g = end.g + _MU * slope_0
        converged = _update(low, high, at_psi if opened else at_phi)
        trials += 1
    return float(a), trials


def _psi(at: _Point, phi_0: np.float64, slope_0: np.float64) -> _Point:
    return _Point(at.a, at.f - phi_0 - _MU * slope_0 * at.a, at.g - _MU * slope_0)


def _clip(a: float, low: float, high: float) -> float:
    # std::max(std::min(a, high), low): a NaN stays one in both
    a = high if high < a else a
    return low if a < low else a


def _update(low: _Point, high: _Point, at: _Point) -> bool:
    """Shrink the interval; whether it has converged."""
    if at.f > low.f:
        high.a, high.f, high.g = at.a, at.f, at.g
        return False
    side = at.g * (low.a - at.a)
    if side > 0:
        low.a, low.f, low.g = at.a, at.f, at.g
        return False
    if side < 0:
        high.a, high.f, high.g = low.a, low.f, low.g
        low.a, low.f, low.g = at.a, at.f, at.g
        return False
    return True


def _cubic(end: _Point, at: _Point) -> np.float64:
    """Minimiser of the cubic through both values and slopes, eq. 2.4.52 and 2.4.56 of Sun and Yuan 2006."""
    z = 3 * (at.f - end.f) / (at.a - end.a) - at.g - end.g
    w = np.sqrt(z * z - at.g * end.g)
    least: np.float64 = end.a + (at.a - end.a) * (w - end.g - z) / (at.g - end.g + 2 * w)
    return least


def _secant(end: _Point, at: _Point) -> np.float64:
    crossing: np.float64 = end.a - (end.a - at.a) / (end.g - at.g) * end.g
    return crossing


def _trial(low: _Point, high: _Point, at: _Point, by_upper_end: bool) -> float:
    """Trial value selection, section 4 of More and Thuente 1994."""
    if by_upper_end and at.a == low.a:
        return float(at.a if at.a == high.a else _cubic(high, at))
    if at.f > low.f:
        cubic = _cubic(low, at)
        quadratic = low.a - 0.5 * (low.a - at.a) * low.g / (low.g - (low.f - at.f) / (low.a - at.a))
        near = abs(cubic - low.a) < abs(quadratic - low.a)
        return float(cubic if near else 0.5 * (quadratic + cubic))
    if at.g * low.g < 0:
        cubic, secant = _cubic(low, at), _secant(low, at)
        return float(cubic if abs(cubic - at.a) >= abs(secant - at.a) else secant)
    if abs(at.g) <= abs(low.g):
        cubic, secant = _cubic(low, at), _secant(low, at)
        following = cubic if abs(cubic - at.a) < abs(secant - at.a) else secant
        bound = at.a + 0.66 * (high.a - at.a)
        if at.a > low.a:
            return float(following if following < bound else bound)
        return float(following if bound < following else bound)
    return float(_cubic(high, at))

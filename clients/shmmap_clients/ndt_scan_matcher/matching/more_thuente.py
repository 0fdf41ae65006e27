# SPDX-License-Identifier: Apache-2.0
"""The line search of More and Thuente (1994), exactly as in PCL and ndt_omp.

Where the originals divide by zero, they continue with an infinity or a NaN, and so does this module.  PCL
and ndt_omp differ in one case, see `line_search`.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from typing import Final

import numpy as np

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


def line_search(
    first: float,
    step_min: float,
    step_max: float,
    phi_0: float,
    dphi_0: float,
    *,
    by_upper_end: bool,
) -> Search:
    """Find a step length along a descent direction; return it and the number of trials after the first.

    The generator yields each trial step length, and is sent the negated score and its slope there.

    Parameters
    ----------
    first
        Newton's own step length.
    step_min, step_max
        Bounds of the step length; if they leave no room, ``first`` is taken.
    phi_0, dphi_0
        The negated score and its slope at the start; the slope is negative.
    by_upper_end
        Rule for a last trial that has become the lower end: True uses the cubic through the upper end, as
        PCL 1.13; False divides by zero, as ndt_omp.
    """
    zero, value_0, slope_0 = np.float64(0.0), np.float64(phi_0), np.float64(dphi_0)
    with np.errstate(all="ignore"):
        # psi(a) = phi(a) - phi(0) - mu phi'(0) a, eq. 2.1
        low, high = (_Point(zero, zero, slope_0 - _MU * slope_0) for _ in range(2))
    converged, opened, trials = step_max - step_min < 0, True, 0
    a = np.float64(_clip(first, step_min, step_max))
    while True:
        value, slope = yield float(a)
        with np.errstate(all="ignore"):
            at_phi = _Point(a, np.float64(value), np.float64(slope))
            at_psi = _Point(a, at_phi.f - value_0 - _MU * slope_0 * a, at_phi.g - _MU * slope_0)
            if trials:
                if opened and at_psi.f <= 0 and at_psi.g >= 0:
                    opened = False
                    for end in (low, high):
                        # the sign of mu is as in the originals
                        end.f = end.f + value_0 - _MU * slope_0 * end.a
                        end.g = end.g + _MU * slope_0
                converged = _update(low, high, at_psi if opened else at_phi)
            if converged or trials == MAX_TRIALS or (at_psi.f <= 0 and at_phi.g <= -_NU * slope_0):
                return float(a), trials
            trial = _trial(low, high, at_psi if opened else at_phi, by_upper_end)
            a = np.float64(_clip(trial, step_min, step_max))
        trials += 1


def _clip(a: float, low: float, high: float) -> float:
    # std::max(std::min(a, high), low): a NaN stays one in both
    a = high if high < a else a
    return low if a < low else a


def _update(low: _Point, high: _Point, at: _Point) -> bool:
    """Shrink the interval; return whether it has converged."""
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
    """Return the minimiser of the cubic of both values and slopes, Sun and Yuan 2006, eq. 2.4.52, 2.4.56."""
    z = 3 * (at.f - end.f) / (at.a - end.a) - at.g - end.g
    w = np.sqrt(z * z - at.g * end.g)
    least: np.float64 = end.a + (at.a - end.a) * (w - end.g - z) / (at.g - end.g + 2 * w)
    return least


def _secant(end: _Point, at: _Point) -> np.float64:
    crossing: np.float64 = end.a - (end.a - at.a) / (end.g - at.g) * end.g
    return crossing


def _trial(low: _Point, high: _Point, at: _Point, by_upper_end: bool) -> float:
    """Select the next trial value, section 4 of More and Thuente 1994."""
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

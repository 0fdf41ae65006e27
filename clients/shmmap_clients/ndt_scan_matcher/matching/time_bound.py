# SPDX-License-Identifier: Apache-2.0
"""How long an alignment can take at most: evaluations times points times the cost of one, measured here.

The three limits bound the work: no scan, map or guess makes it more.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shmmap_clients.ndt_scan_matcher.matching.evaluation import pose_from_matrix
from shmmap_clients.ndt_scan_matcher.matching.matcher import NdtMatcher

__all__ = ["TimeBound", "predict_time_bound"]

_REPEATS = 3


@dataclass(frozen=True, slots=True)
class TimeBound:
    """A bound of the time of one alignment on this machine.

    Attributes
    ----------
    evaluations
        Passes over the scan, at most.
    points
        Of a scan, at most.
    point_ns
        Time of one point in one pass, measured on the given scan, scaled up to as many neighbours as the
        limit allows: processor time where this thread computes, else, on a device, time that passes.
    deadline_s
        The limit on one alignment's time; None: none.
    """

    evaluations: int
    points: int
    point_ns: float
    deadline_s: float | None = None

    @property
    def pass_ms(self) -> float:
        """The bound of one pass, milliseconds."""
        return self.points * self.point_ns * 1e-6

    @property
    def total_ms(self) -> float:
        """The bound, milliseconds on one thread that has a processor for itself, or on the device."""
        most = self.evaluations * self.pass_ms
        # a pass that has begun before the deadline is finished
        return most if self.deadline_s is None else min(most, self.deadline_s * 1e3 + self.pass_ms)

    def describe(self) -> str:
        """Return the bound with what it is made of."""
        return (
            f"worst case for the largest scan allowed: {self.total_ms / 1e3:.1f} s"
            f" ({self.points} points x {self.evaluations} evaluations x {self.point_ns:.0f} ns"
            f"{'' if self.deadline_s is None else f', or {self.deadline_s:g} s and one evaluation'}); a lower"
            " --max-points lowers it"
        )


def predict_time_bound(
    matcher: NdtMatcher, points: NDArray[np.floating], T: NDArray[np.float64]
) -> TimeBound:
    """Predict from the limits and from evaluations of one scan.

    Parameters
    ----------
    matcher
        With a map.
    points : (N, 3)
        A typical scan.
    T : (4, 4)
        Where it lies.
    """
    pose = pose_from_matrix(T)[None, :]
    costs = []
    per_point = 1.0
    matcher.evaluate(points, pose)
    for _ in range(_REPEATS):
        # what a device does is in no thread of this process
        clock = time.perf_counter_ns if matcher.on_device else time.thread_time_ns
        begin = clock()
        at = matcher.evaluate(points, pose)[0]
        costs.append(clock() - begin)
        per_point = max(at.neighbours / max(len(points), 1), 1.0)
    used = max(min(len(points), matcher.limits.source_points), 1)
    # what a point costs grows no faster than its neighbours
    ceiling = max(1.0, matcher.most_neighbors / per_point)
    return TimeBound(
        matcher.most_evaluations,
        matcher.limits.source_points,
        min(costs) / used * ceiling,
        matcher.limits.deadline_s,
    )

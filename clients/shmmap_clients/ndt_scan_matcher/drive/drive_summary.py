# SPDX-License-Identifier: Apache-2.0
"""One scan's result as JSON, and statistics of a drive: errors, scores, latencies, costs of the map."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter, deque
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap_clients.ndt_scan_matcher.backends.backend import DeviceError
from shmmap_clients.ndt_scan_matcher.drive.follower import Frame
from shmmap_clients.ndt_scan_matcher.map.map_updater import UpdateStatistics
from shmmap_clients.ndt_scan_matcher.matching.result import TrustLimits
from shmmap_clients.scans.trajectory import quaternion_of
from shmmap_clients.spread import RunningSpread, Spread

_STRETCHES_M: Final = (10.0, 50.0, 100.0)
_START_EVERY_M: Final = 0.05  # a standing vehicle starts no stretches
Matrix = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class TrajectoryErrors:
    """Errors of a trajectory.

    Attributes
    ----------
    ate_m, ate_deg
        Absolute error of each pose in the map frame, without fitting.
    ate_rmse_m
        Root of the mean square.
    rte
        Mean relative error over stretches, metres per 100 m, by the stretch's length in metres.
    """

    ate_m: Spread
    ate_deg: Spread
    ate_rmse_m: float
    rte: dict[float, float]


def pose_errors(
    poses: NDArray[np.float64], truth: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return distance, metres, and angle, degrees, between (N, 4, 4) poses and the truth."""
    off = np.linalg.inv(truth) @ poses
    cosine = np.clip((np.trace(off[:, :3, :3], axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0)
    return np.linalg.norm(off[:, :3, 3], axis=1), np.degrees(np.arccos(cosine))


class RunningErrors:
    """Running comparison of poses with the truth, in constant memory."""

    def __init__(self) -> None:
        self._ate_m, self._ate_deg = RunningSpread(), RunningSpread()
        self._way = 0.0
        self._last: Matrix | None = None
        # by length of stretch: starts of stretches that have not ended, with both poses
        self._starts: dict[float, deque[tuple[float, Matrix, Matrix]]] = {m: deque() for m in _STRETCHES_M}
        self._rte = {metres: RunningSpread() for metres in _STRETCHES_M}

    def add(self, pose: Matrix, truth: Matrix) -> None:
        """Add the next pose, (4, 4), and the true one."""
        metres, degrees = pose_errors(pose[None], truth[None])
        self._ate_m.add(float(metres[0]))
        self._ate_deg.add(float(degrees[0]))
        if self._last is not None:
            self._way += float(np.linalg.norm(truth[:3, 3] - self._last[:3, 3]))
        self._last = truth
        for stretch, starts in self._starts.items():
            while starts and starts[0][0] + stretch <= self._way:
                _, pose_then, truth_then = starts.popleft()
                ours = np.linalg.inv(pose_then) @ pose
                theirs = np.linalg.inv(truth_then) @ truth
                off = np.linalg.inv(theirs) @ ours
                self._rte[stretch].add(float(np.linalg.norm(off[:3, 3])) * 100.0 / stretch)
            if not starts or self._way - starts[-1][0] >= _START_EVERY_M:
                starts.append((self._way, pose, truth))

    @property
    def errors(self) -> TrajectoryErrors | None:
        """Errors of all poses so far; None before the first one."""
        if not self._ate_m.count:
            return None
        rte = {metres: running.spread.mean for metres, running in self._rte.items() if running.count}
        return TrajectoryErrors(self._ate_m.spread, self._ate_deg.spread, self._ate_m.root_mean_square, rte)


@dataclass(frozen=True, slots=True)
class DriveSummary:
    """Statistics of a drive.

    Attributes
    ----------
    frames, converged, trustworthy
        Number of scans, and of converged and trustworthy alignments.
    no_map
        Scans that had no map around them.
    lost, relocalized, clock_jumps
        Number of times the vehicle was lost, of searches that found it again, and of scans before which
        the clock had jumped.
    failed_limits
        Number of results that failed each limit of trust, by the limit's name.
    trust
        Limits of trust.
    waited
        Scans that had to wait for the map; the first always does.
    too_slow
        Number of times the map no longer reached far enough.
    cut_frames
        Number of scans for which a limit left something out.
    cut_by
        Number of these scans by limit: ``points``, ``neighbors``, ``voxels``, ``map_bytes``,
        ``deadline``.
    backend
        Name of the backend that computed last.
    fault
        Reason for using the fallback; None if it was not used.
    errors
        Errors of the trajectory; None without truth.
    transform_probability, nvtl, iterations
        Spreads over the scans.
    latency_ms, align_ms, thin_ms, map_ms
        Time from receiving the scan to the pose, and its parts, without the first scan, which waits for
        the map and the compiler's cache.
    map_updates, cells_added, cells_removed
        Changes of the map in use.
    map_request_ms, map_build_ms, map_prepare_ms
        Time of these changes in another thread; ``build`` includes ``prepare``, see `UpdateStatistics`.
    map_private_bytes
        Largest private memory of this process for a map.
    map_written_bytes, map_writes, map_laid_out_again
        Counts of writes to a device, see `UploadStatistics`.
    """

    frames: int
    converged: int
    trustworthy: int
    no_map: int
    lost: int
    relocalized: int
    clock_jumps: int
    failed_limits: dict[str, int]
    trust: TrustLimits
    waited: int
    too_slow: int
    cut_frames: int
    cut_by: dict[str, int]
    backend: str
    fault: str | None
    errors: TrajectoryErrors | None
    transform_probability: Spread
    nvtl: Spread
    iterations: Spread
    latency_ms: Spread
    align_ms: Spread
    thin_ms: Spread
    map_ms: Spread
    map_updates: int
    cells_added: int
    cells_removed: int
    map_request_ms: Spread
    map_build_ms: Spread
    map_prepare_ms: Spread
    map_private_bytes: int
    map_written_bytes: int
    map_writes: int
    map_laid_out_again: int

    def as_document(self) -> dict[str, Any]:
        """Return the summary for JSON, with null for missing numbers."""
        document = _without_nan(dataclasses.asdict(self))
        assert isinstance(document, dict)  # noqa: S101  # a dataclass is one
        return document


class DriveStatistics:
    """Running statistics of frames, in constant memory."""

    def __init__(self) -> None:
        self.frames = self.trustworthy = self.no_map = self.clock_jumps = 0
        self._converged = self._waited = self._cut = self._lost = self._relocalized = 0
        self._failed_limits: Counter[str] = Counter()
        self._cut_by: Counter[str] = Counter()
        self._errors = RunningErrors()
        self._results = {name: RunningSpread() for name in ("transform_probability", "nvtl", "iterations")}
        self._times = {name: RunningSpread() for name in ("latency_s", "align_s", "thin_s", "map_s")}

    def add(self, frame: Frame) -> None:
        """Add the next frame."""
        result = frame.result
        self.frames += 1
        self._converged += result.converged
        self.trustworthy += result.trustworthy
        self.no_map += result.no_map
        self._failed_limits.update(result.failed_limits)
        self._waited += frame.waited
        self._cut += bool(result.cut)
        self._cut_by.update(result.cut.by)
        self._lost += frame.state == "lost"
        self._relocalized += frame.relocalized
        self.clock_jumps += frame.clock_jumped
        if frame.T_truth is not None:
            self._errors.add(result.T_map_base, frame.T_truth)
        for name, running in self._results.items():
            running.add(float(getattr(result, name)))
        if self.frames > 1:
            for name, running in self._times.items():
                running.add(getattr(frame, name) * 1e3)

    def summary(
        self,
        updates: UpdateStatistics,
        too_slow: int,
        trust: TrustLimits,
        *,
        backend: str = "numba",
        fault: DeviceError | None = None,
    ) -> DriveSummary:
        """Return the summary of the drive so far, with map updates, limits of trust, and the backend."""
        return DriveSummary(
            frames=self.frames,
            converged=self._converged,
            trustworthy=self.trustworthy,
            no_map=self.no_map,
            lost=self._lost,
            relocalized=self._relocalized,
            clock_jumps=self.clock_jumps,
            failed_limits=dict(self._failed_limits),
            trust=trust,
            waited=self._waited,
            too_slow=too_slow,
            cut_frames=self._cut,
            cut_by=dict(self._cut_by),
            backend=backend,
            fault=None if fault is None else str(fault),
            errors=self._errors.errors,
            transform_probability=self._results["transform_probability"].spread,
            nvtl=self._results["nvtl"].spread,
            iterations=self._results["iterations"].spread,
            latency_ms=self._times["latency_s"].spread,
            align_ms=self._times["align_s"].spread,
            thin_ms=self._times["thin_s"].spread,
            map_ms=self._times["map_s"].spread,
            map_updates=updates.updates,
            cells_added=updates.added,
            cells_removed=updates.removed,
            map_request_ms=updates.request_ms.spread,
            map_build_ms=updates.build_ms.spread,
            map_prepare_ms=updates.prepare_ms.spread,
            map_private_bytes=updates.private_bytes,
            map_written_bytes=updates.uploads.written_bytes,
            map_writes=updates.uploads.writes,
            map_laid_out_again=updates.uploads.laid_out_again,
        )


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _without_nan(item) for key, item in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def frame_document(frame: Frame) -> dict[str, Any]:
    """Return the JSON object that ``shmmap-ndt follow --json-lines`` writes for one scan.

    Returns
    -------
    dict
        ``name``; ``stamp_s``; ``pose``: x, y, z (metres, map frame) and the quaternion qx, qy, qz, qw;
        ``converged``, ``trustworthy``, and ``failed_limits``, see `TrustLimits.failed`;
        ``no_map``; ``state``: ``tracking``, ``uncertain`` or ``lost``; ``relocalized``; ``clock_jumped``;
        ``iterations``, ``transform_probability``, ``nvtl``; ``waited`` (for the map);
        ``latency_ms``: from receiving the scan to the pose; ``error_m`` and ``error_deg``: distance
        and angle to the true pose, null for a scan without one.
    """
    result = frame.result
    T = result.T_map_base
    error_m = error_deg = None
    if frame.T_truth is not None:
        metres, degrees = pose_errors(T[None], frame.T_truth[None])
        error_m, error_deg = float(metres[0]), float(degrees[0])
    return {
        "name": frame.name,
        "stamp_s": frame.stamp_s,
        "pose": [*T[:3, 3].tolist(), *quaternion_of(T[:3, :3])],
        "converged": result.converged,
        "trustworthy": result.trustworthy,
        "failed_limits": list(result.failed_limits),
        "no_map": result.no_map,
        "state": frame.state,
        "relocalized": frame.relocalized,
        "clock_jumped": frame.clock_jumped,
        "iterations": result.iterations,
        "transform_probability": result.transform_probability,
        "nvtl": result.nvtl,
        "waited": frame.waited,
        "latency_ms": frame.latency_s * 1e3,
        "error_m": error_m,
        "error_deg": error_deg,
    }

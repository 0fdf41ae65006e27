# SPDX-License-Identifier: Apache-2.0
"""What a whole drive was like: errors, scores, latencies, and what the map's updates cost."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from shmmap_clients.ndt_scan_matcher.drive.follower import Frame
from shmmap_clients.ndt_scan_matcher.drive.trajectory_error import DriveErrors, Spread, drive_errors
from shmmap_clients.ndt_scan_matcher.map.map_updater import MapUpdate

__all__ = ["DriveSummary", "summarize"]


@dataclass(frozen=True, slots=True)
class DriveSummary:
    """A drive in numbers.

    Attributes
    ----------
    frames, converged, trustworthy
        Scans, and how many of their alignments were that.
    waited
        Scans that had to wait for the map; the first always does.
    too_slow
        How often the map did not reach far enough any more.
    cut_frames
        Scans of which a cap left something out.
    errors
        None where no truth was given.
    transform_probability, nvtl, iterations
        Spreads over the scans.
    latency_ms, align_ms, thin_ms, map_ms
        From having the scan to having the pose, and the parts of it; the first scan, which waits for
        the map and the compiler's cache, is left out.
    map_updates, cells_added, cells_removed
        Changes of the map in use.
    map_request_ms, map_build_ms
        What they cost, in another thread.
    map_private_bytes
        This process's own memory for a map, at most.
    """

    frames: int
    converged: int
    trustworthy: int
    waited: int
    too_slow: int
    cut_frames: int
    errors: DriveErrors | None
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
    map_private_bytes: int

    def as_document(self) -> dict[str, Any]:
        """Return the summary for JSON: numbers that are not there are null."""
        document = _without_nan(dataclasses.asdict(self))
        assert isinstance(document, dict)  # noqa: S101  # a dataclass is one
        return document


def summarize(frames: Sequence[Frame], updates: Sequence[MapUpdate], too_slow: int) -> DriveSummary:
    """Summarize a drive."""
    true = [frame for frame in frames if frame.T_truth is not None]
    errors = None
    if true:
        poses = np.array([frame.result.T_map_base for frame in true])
        errors = drive_errors(poses, np.array([frame.T_truth for frame in true]))
    timed = frames[1:]

    def spread(values: Sequence[float], scale: float = 1.0) -> Spread:
        return Spread.of(np.array(values, np.float64) * scale)

    return DriveSummary(
        frames=len(frames),
        converged=sum(frame.result.converged for frame in frames),
        trustworthy=sum(frame.result.trustworthy for frame in frames),
        waited=sum(frame.waited for frame in frames),
        too_slow=too_slow,
        cut_frames=sum(bool(frame.result.cut) for frame in frames),
        errors=errors,
        transform_probability=spread([frame.result.transform_probability for frame in frames]),
        nvtl=spread([frame.result.nvtl for frame in frames]),
        iterations=spread([frame.result.iterations for frame in frames]),
        latency_ms=spread([frame.latency_s for frame in timed], 1e3),
        align_ms=spread([frame.align_s for frame in timed], 1e3),
        thin_ms=spread([frame.thin_s for frame in timed], 1e3),
        map_ms=spread([frame.map_s for frame in timed], 1e3),
        map_updates=len(updates),
        cells_added=sum(update.added for update in updates),
        cells_removed=sum(update.removed for update in updates),
        map_request_ms=spread([update.request_s for update in updates], 1e3),
        map_build_ms=spread([update.build_s for update in updates], 1e3),
        map_private_bytes=max((update.private_bytes for update in updates), default=0),
    )


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _without_nan(item) for key, item in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value

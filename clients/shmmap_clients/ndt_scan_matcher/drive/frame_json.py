# SPDX-License-Identifier: Apache-2.0
"""One scan's result as JSON, for programs that read along while a drive is localized."""

from __future__ import annotations

from typing import Any

from shmmap_clients.ndt_scan_matcher.drive.follower import Frame
from shmmap_clients.ndt_scan_matcher.drive.trajectory_error import pose_errors
from shmmap_clients.scans.trajectory import quaternion_of

__all__ = ["frame_document"]


def frame_document(frame: Frame) -> dict[str, Any]:
    """Return what ``shmmap-ndt follow --json-lines`` writes about one scan.

    Returns
    -------
    dict
        ``name``; ``stamp_s``; ``pose``: x, y, z (metres, map frame) and the quaternion qx, qy, qz, qw;
        ``converged``, ``trustworthy``, and ``failed_limits``: why not, see `TrustLimits.failed`;
        ``no_map``; ``state``: ``tracking``, ``uncertain`` or ``lost``; ``relocalized``; ``clock_jumped``;
        ``iterations``, ``transform_probability``, ``nvtl``; ``waited``: for the map;
        ``latency_ms``: from having the scan to having the pose; ``error_m`` and ``error_deg``: distance
        and angle to the true pose, null where the scan has none.
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

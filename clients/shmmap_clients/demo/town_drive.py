# SPDX-License-Identifier: Apache-2.0
"""The three programs on a drive through the generated town, and how far each is from the truth.

A LiDAR is simulated among moving cars and people; the town tells where the vehicle was, which points belong
to what moves, and how high the road is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.simulation.lidar_drive import LidarDrive
from shmmap_clients.demo.three_programs import ThreePrograms, run_three_programs
from shmmap_clients.scans.scan_sequence import Scan

__all__ = ["ProgramErrors", "drive_through_town"]

_WINDOW_METRES: Final = 80.0
_RESOLUTION_METRES: Final = 0.3  # of the elevation map, where the town is dense enough
_COLUMN_POINTS: Final = 9.0


@dataclass(frozen=True, slots=True)
class ProgramErrors:
    """How far the programs are from the truth.

    Attributes
    ----------
    ndt
        ``mean_m`` and ``max_m``: distance of the positions from the true ones.
    compare
        ``moving_kept`` and ``still_kept``: which share of the points on what moves, and of all others, was
        kept.  The first should be large, the second small.
    elevation
        ``mean_m`` and ``max_m``: the road's height against the true one, at so many ``places`` of the way
        (null: none of them was measured).
    """

    ndt: dict[str, float | None]
    compare: dict[str, float]
    elevation: dict[str, float | None]


def drive_through_town(
    drive: LidarDrive,
    endpoint: str,
    shm_dir: str,
    instance: str,
    work: Path,
    after_scan: Callable[[ThreePrograms], None] | None = None,
) -> tuple[ThreePrograms, ProgramErrors]:
    """Drive with the three programs on a daemon that serves the drive's town.

    Parameters
    ----------
    endpoint, shm_dir, instance
        The daemon's.
    work
        Directory for sockets, caches and outputs.
    after_scan
        Called after each scan was sent.

    Raises
    ------
    InternalError
        A program failed.
    """
    window = ["--update-distance", "10"]
    heights = work / "elevation.npz"
    resolution = max(_RESOLUTION_METRES, math.sqrt(_COLUMN_POINTS / drive.town.density))
    result = run_three_programs(
        endpoint, shm_dir, instance, _scans(drive), drive.odometry(), work,
        ndt=["--map-radius", str(_WINDOW_METRES), "--lidar-radius", str(drive.lidar.farthest), *window],
        compare=["--mode", "distance", "--map-radius", str(_WINDOW_METRES), *window],
        elevation=["--resolution", f"{resolution:.2f}", "--out", str(heights)],
        after_scan=after_scan,
    )  # fmt: skip
    return result, _errors(drive, result, heights)


def _scans(drive: LidarDrive) -> Iterator[Scan]:
    for number, scan in enumerate(drive.scans()):
        columns: dict[str, NDArray[Any]] = {"xyz": scan.xyz, "ring": scan.ring, "moving": scan.moving}
        yield Scan(f"scan_{number:04}", scan.stamp_s, columns, scan.T_map_sensor)


def _errors(drive: LidarDrive, result: ThreePrograms, heights: Path) -> ProgramErrors:
    found = result.programs["ndt"].document["errors"]["ate_m"]
    still, kept_still = result.sent - result.sent_moving, result.kept - result.kept_moving
    return ProgramErrors(
        ndt={"mean_m": found["mean"], "max_m": found["max"]},
        compare={
            "moving_kept": result.kept_moving / max(1, result.sent_moving),
            "still_kept": kept_still / max(1, still),
        },
        elevation=_road_errors(drive, heights),
    )


def _road_errors(drive: LidarDrive, heights: Path) -> dict[str, float | None]:
    """Compare the elevation map with the true ground where the vehicle drove."""
    way = drive.town.route(length=drive.length, step=drive.step)
    x, y = way[:, 0], way[:, 1]
    with np.load(heights) as found:
        column, row = (
            ((at - origin) / found["resolution"]).astype(int)
            for at, origin in zip((x, y), found["origin"], strict=True)
        )
        height = found["height"][row, column].astype(np.float64)
    off = np.abs(height - drive.town.ground_height(x, y))
    off = off[np.isfinite(off)]
    if not len(off):
        return {"mean_m": None, "max_m": None, "places": 0}
    return {"mean_m": float(off.mean()), "max_m": float(off.max()), "places": len(off)}

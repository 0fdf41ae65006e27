# SPDX-License-Identifier: Apache-2.0
"""Localize simulated scans with known poses in the map, by the program ``shmmap-ndt follow``.

``python -m shmmap.demo.localization OUT SEED BLOCKS_X BLOCKS_Y LENGTH`` makes the scans: it writes
``scans/*.npz``, ``truth.txt`` and ``odometry.txt`` (both in the TUM format) to the directory OUT.  Then it
compiles the kernels of layers, so that no daemon compiles during a measurement.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import math
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from shmmap.demo.demo_town import DemoSettings
from shmmap.demo.program import Program, Progress
from shmmap.errors import InternalError
from shmmap.processes.end_with_parent import with_us
from shmmap.testing.daemon_process import DaemonProcess

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_PROGRAM: Final = "shmmap_clients.ndt_scan_matcher"
_WINDOW_METRES: Final = 80.0
_SEEN_METRES: Final = 45.0  # range of the LiDAR
_SURFACE_DENSITY: Final = 15.0
_TIMEOUT_S: Final = 300.0  # seconds for a compiler on a slow machine


@dataclass(frozen=True, slots=True)
class LocalizationResult:
    """Results of the localization program.

    Attributes
    ----------
    scans, trustworthy
        Localized scans, and how many of them the program marks as trustworthy.
    error_m, error_max_m
        Distance between estimated and true positions: mean and largest, metres.
    first_pose_s
        Seconds from the start of the daemon, and then of the program, to the first scan's pose.
    """

    scans: int
    trustworthy: int
    error_m: float
    error_max_m: float
    first_pose_s: float


def missing_package() -> str:
    """Return the name of a package that the localization needs but is not installed; empty if complete."""
    return "" if importlib.util.find_spec("numba") is not None else "numba"


def prepare(settings: DemoSettings, work: Path, stack: contextlib.ExitStack) -> list[Program]:
    """Start processes that make scans and compile kernels; they are killed with ``stack`` at the latest."""
    words = [str(work), str(settings.seed), *map(str, settings.blocks), str(settings.localized)]
    makers = [
        Program("simulated scans", "shmmap.demo.localization", words, work),
        Program("shmmap-ndt warmup", _PROGRAM, ["warmup"], work),
    ]
    return [stack.enter_context(maker) for maker in makers]


def wait_prepared(makers: Sequence[Program]) -> None:
    """Wait for the scans and the kernels, so that their making does not disturb a measurement.

    Raises
    ------
    InternalError
        Scans or kernels could not be made.
    """
    for maker in makers:
        maker.finish(_TIMEOUT_S)


def localize(map_path: str, options: Sequence[str], work: Path, progress: Progress) -> LocalizationResult:
    """Localize all scans with a new daemon whose cache is empty.

    Parameters
    ----------
    map_path, options
        Map and options of the daemon.
    work
        Directory of the prepared scans.

    Raises
    ------
    InternalError
        The program failed.
    """
    scans, truth = work / "scans", str(work / "truth.txt")
    progress.stage("Localizing simulated LiDAR scans with shmmap-ndt", len(list(scans.iterdir())))
    started_s = time.perf_counter()
    first_pose_s = math.nan
    with DaemonProcess(map_path, *options, command=with_us()) as daemon:
        words = [
            "follow",
            "--scans",
            str(scans),
            "--truth",
            truth,
            "--odometry",
            str(work / "odometry.txt"),
            "--endpoint",
            daemon.endpoint,
            "--json",
            "--json-lines",
            "-",
            "--quiet",
            "--map-radius",
            str(_WINDOW_METRES),
            "--lidar-radius",
            str(_SEEN_METRES),
            "--update-distance",
            "10",
            "--route",
            truth,
        ]
        with Program("shmmap-ndt", _PROGRAM, words, work) as program:
            document: dict[str, Any] = {}
            for line in program.lines(_TIMEOUT_S):
                document = json.loads(line)
                if "error_m" in document:
                    if math.isnan(first_pose_s):
                        first_pose_s = time.perf_counter() - started_s
                    progress.step(f"{document['name']}: {document['error_m'] * 100:.1f} cm from the truth")
            program.finish(_TIMEOUT_S, fails=True)
    if "frames" not in document:
        raise InternalError(f"shmmap-ndt ended with {program.exit_code} and without a result")
    errors_m = document["errors"]["ate_m"]
    return LocalizationResult(
        scans=document["frames"],
        trustworthy=document["trustworthy"],
        error_m=errors_m["mean"],
        error_max_m=errors_m["max"],
        first_pose_s=first_pose_s,
    )


def main(argv: list[str]) -> int:
    """Simulate scans, write them, and compile kernels."""
    import numpy as np

    from shmmap.layers.build import compile_kernels
    from shmmap.simulation.lidar import Lidar, LidarDrive
    from shmmap.simulation.town import Town

    out, length = Path(argv[0]), float(argv[4])
    town = Town(seed=int(argv[1]), blocks=(int(argv[2]), int(argv[3])))
    lidar = Lidar(rings=32, azimuth_deg=0.6, farthest=_SEEN_METRES)
    drive = LidarDrive(town, length, lidar=lidar, density=_SURFACE_DENSITY)
    _write_poses(out / "truth.txt", drive.poses())
    _write_poses(out / "odometry.txt", drive.odometry())
    (out / "scans").mkdir()
    for number, scan in enumerate(drive.scans()):
        np.savez(out / "scans" / f"scan_{number:04}.npz", xyz=scan.xyz)
    compile_kernels()
    return 0


def _write_poses(path: Path, poses: Iterable[tuple[float, NDArray[np.float64]]]) -> None:
    """Write poses with rotation about z only, as lines ``t x y z qx qy qz qw``."""
    lines = []
    for stamp_s, T in poses:
        heading = math.atan2(T[1, 0], T[0, 0])
        x, y, z = T[:3, 3].tolist()
        turn = f"0 0 {math.sin(heading / 2):.9f} {math.cos(heading / 2):.9f}"
        lines.append(f"{stamp_s:.9f} {x:.9f} {y:.9f} {z:.9f} {turn}\n")
    path.write_text("".join(lines), encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

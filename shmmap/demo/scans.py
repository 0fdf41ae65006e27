# SPDX-License-Identifier: Apache-2.0
"""The scans that the demonstration localizes, made in a process of their own.

``python -m shmmap.demo.scans OUT SEED BLOCKS_X BLOCKS_Y LENGTH`` writes ``scans/*.npz``, ``truth.txt`` and
``odometry.txt`` (both in the TUM format) to the directory OUT.  In the end it compiles
the kernels of layers, which the first daemon would do beside what is measured.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap.layers.compiling import compile_kernels
from shmmap.simulation.lidar import Lidar
from shmmap.simulation.lidar_drive import LidarDrive
from shmmap.simulation.town import Town

__all__ = ["SEEN_METRES", "main"]

SEEN_METRES: Final = 45.0
"""How far the LiDAR sees."""

_SURFACE_DENSITY: Final = 15.0


def main(argv: list[str]) -> int:
    """Simulate, write, compile."""
    out, length = Path(argv[0]), float(argv[4])
    town = Town(seed=int(argv[1]), blocks=(int(argv[2]), int(argv[3])))
    lidar = Lidar(rings=32, azimuth_deg=0.6, farthest=SEEN_METRES)
    drive = LidarDrive(town, length, lidar=lidar, density=_SURFACE_DENSITY)
    _write_poses(out / "truth.txt", drive.poses())
    _write_poses(out / "odometry.txt", drive.odometry())
    (out / "scans").mkdir()
    for number, scan in enumerate(drive.scans()):
        np.savez(out / "scans" / f"scan_{number:04}.npz", xyz=scan.xyz)
    compile_kernels()
    return 0


def _write_poses(path: Path, poses: Iterable[tuple[float, NDArray[np.float64]]]) -> None:
    """Write ``t x y z qx qy qz qw`` of poses that turn about z alone."""
    lines = []
    for stamp_s, T in poses:
        heading = math.atan2(T[1, 0], T[0, 0])
        x, y, z = T[:3, 3].tolist()
        turn = f"0 0 {math.sin(heading / 2):.9f} {math.cos(heading / 2):.9f}"
        lines.append(f"{stamp_s:.9f} {x:.9f} {y:.9f} {z:.9f} {turn}\n")
    path.write_text("".join(lines), encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

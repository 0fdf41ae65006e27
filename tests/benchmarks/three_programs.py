# SPDX-License-Identifier: Apache-2.0
"""NDT matcher, compare filter and elevation map as separate processes on one daemon, over a drive.

The drive's scans are taken tile after tile on copies of the street side by side, for some minutes:
windows move, jump from tile to tile, and cells come and go in a budget that holds a small part of the
map.  Printed are each program's times and own memory, how much of that grew in the last third, shared
memory, and what was lost or left.  A machine of two cores shows mostly how they share them.

    SHMMAP_TEST_DATA=DIR python -m tests.benchmarks.three_programs [--minutes 4] [--tiles 4]
        [--budget-mib 300] [--out DIR]

Measured with ``--tiles 10 --minutes 10 --budget-mib 600``: `shmmap-ndt` 12.7 ms (median), 172.7 ms (99th
percentile: jumps to another tile, whose map is loaded first), 120 MiB of its own, 1.3 MiB more in the last
third; `shmmap-compare` 12.1 and 29.1 ms, 192 MiB, 39.6 MiB less; `shmmap-elevation`, five times the whole
map, 144 MiB, 6.2 MiB less.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from shmmap_clients.scans.scan_sequence import Scan, ScanSequence
from shmmap_clients.scans.trajectory import read_trajectory

import shmmap
from tests.benchmarks.programs_side_by_side import ThreePrograms, run_three_programs, table
from tests.benchmarks.street_data import TILE_M, street
from tests.benchmarks.tile_map import tile_map
from tests.support.daemon_process import DaemonProcess

SCAN_S = 0.5


def moved(T: NDArray[np.float64], x: float, y: float) -> NDArray[np.float64]:
    """A pose, shifted."""
    result = np.array(T)
    result[0, 3] += x
    result[1, 3] += y
    return result


def tile_corners(tiles: int) -> list[tuple[float, float]]:
    """Where each tile's copy lies, row by row and back."""
    rows = [[(TILE_M * c, TILE_M * r) for c in range(tiles)] for r in range(tiles)]
    return [corner for r, row in enumerate(rows) for corner in (row[::-1] if r % 2 else row)]


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=4.0)
    parser.add_argument("--tiles", type=int, default=4)
    parser.add_argument("--budget-mib", type=int, default=300)
    parser.add_argument("--out", type=Path, help="where ndt.svg and compare.svg go")
    args = parser.parse_args()
    street_data = street()
    sequence = list(ScanSequence(street_data.scan_folder, read_trajectory(street_data.scan_poses_file)))
    corners = tile_corners(args.tiles)
    end_s = 0.0

    def drive() -> Iterator[Scan]:
        for number, (turn, scan) in enumerate(
            (turn, scan) for turn in itertools.count() for scan in sequence
        ):
            if time.monotonic() > end_s:
                return
            x, y = corners[turn % len(corners)]
            T = scan.T_map_sensor
            assert T is not None
            yield dataclasses.replace(
                scan, name=f"{turn}/{scan.name}", stamp_s=number * SCAN_S, T_map_sensor=moved(T, x, y)
            )

    def poses(turns: int) -> Iterator[tuple[float, NDArray[np.float64]]]:
        for number, (turn, scan) in enumerate(itertools.product(range(turns), sequence)):
            assert scan.T_map_sensor is not None
            yield number * SCAN_S, moved(scan.T_map_sensor, *corners[turn % len(corners)])

    with tempfile.TemporaryDirectory() as name:
        directory = Path(name)
        written = tile_map(
            street_data.map_file,
            directory / "map",
            copies=args.tiles,
            pitch=TILE_M,
        )
        points = f"{written.points / 1e6:.0f} million points"
        print(f"map: {written.cells} cells, {points}, load {os.getloadavg()[0]:.1f}")
        one = DaemonProcess(directory / "map", "--budget", str(args.budget_mib << 20)).start()
        try:
            end_s = time.monotonic() + 60 * args.minutes
            work = directory / "work"
            work.mkdir()
            result = run_three_programs(
                one.endpoint, one.shm_dir, one.instance, drive(), poses(len(corners) * 20), work,
                ndt=["--map-radius", "100", "--lidar-radius", "70", "--update-distance", "10"],
                compare=["--mode", "distance", "--map-radius", "100"],
                elevation=["--resolution", "0.5", "--wait", "120"],
            )  # fmt: skip
            print("\n".join(table(result)))
            with shmmap.connect(one.endpoint) as client:
                client.evict()
                unknown = client.stats().unknown_holders
            print(verdict(result, args.budget_mib << 20, len(one.segments()), unknown))
            if args.out:
                args.out.mkdir(parents=True, exist_ok=True)
                for picture in ("ndt.svg", "compare.svg"):
                    shutil.copy(work / picture, args.out)
        finally:
            code = one.stop()
            left = one.leftovers()
            one.dispose()
        print(f"daemon: exit code {code}, left behind: {left or 'nothing'}")


def verdict(result: ThreePrograms, budget_bytes: int, segments: int, unknown: int) -> str:
    """What was left, in a line."""
    return (
        f"budget exceeded: {max(result.segment_bytes) > budget_bytes}; segments that cannot be evicted:"
        f" {segments}, unknown holders: {unknown}"
    )


if __name__ == "__main__":
    main()

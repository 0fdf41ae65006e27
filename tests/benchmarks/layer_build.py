# SPDX-License-Identifier: Apache-2.0
"""Voxel statistics beside PCL's VoxelGridCovariance: one grid of 2 million points, and 256 cells of 20 m.

    python -m tests.benchmarks.layer_build [--rounds 5] [--points 2000000]

One thread, CPU time, the minimum over rounds; both programs take turns.  Ours includes the inverse
covariances and the lookup table, PCL's has its statistics without the search tree.  Limits: 0.25 for the one
grid, 0.7 for the cells.  PCL's part needs g++ and libpcl-dev, and is left out where they are missing.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shmmap.layers.build import build_layer
from tests.support.compiled_programs import built_pcl_program
from tests.support.daemon_process import LineProcess

CELL_M = 20.0


def city(points: int) -> NDArray[np.float32]:
    """Ground, walls and clutter over 400 x 400 m, in random order: (points, 3) float32, metres."""
    rng = np.random.default_rng(4)
    xy = rng.uniform(-200, 200, (points, 2))
    z = np.sin(xy[:, 0] / 30) + rng.normal(0, 0.03, points)
    wall = rng.random(points) < 0.5
    xy[wall, 0] = np.round(xy[wall, 0] / 12) * 12 + rng.normal(0, 0.03, wall.sum())
    z[wall] += rng.uniform(0, 10, wall.sum())
    clutter = rng.random(points) < 0.1
    z[clutter] += rng.uniform(0, 6, clutter.sum())
    return np.column_stack([xy, z]).astype(np.float32)


def cells_of(xyz: NDArray[np.float32], across: int = 16) -> list[NDArray[np.float32]]:
    """The middle across x across cells of 20 m."""
    index = np.floor(xyz[:, :2] / CELL_M).astype(int) + across // 2
    inside = ((index >= 0) & (index < across)).all(axis=1)
    number = index[inside, 0] * across + index[inside, 1]
    order = np.argsort(number, kind="stable")
    ends = np.cumsum(np.bincount(number, minlength=across * across))
    return [np.ascontiguousarray(part) for part in np.split(xyz[inside][order], ends[:-1])]


class Pcl:
    """The C++ program."""

    def __init__(self, program: Path) -> None:
        self._program = LineProcess(program)

    def seconds(self, leaf: float, paths: list[Path]) -> tuple[float, int]:
        """CPU seconds for the statistics of these files, and their voxels."""
        self._program.write(f"{leaf} {' '.join(map(str, paths))}")
        took, voxels = self._program.read().split()
        return float(took), int(voxels)

    def close(self) -> None:
        """End it."""
        self._program.end()


def ours(leaf: float, clouds: list[NDArray[np.float32]]) -> float:
    """CPU seconds of the ndt layer of each cloud."""
    began = time.thread_time()
    for cloud in clouds:
        build_layer(f"ndt(leaf={leaf})", cloud)
    return time.thread_time() - began


def main() -> None:
    """Measure and print one line for each case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--points", type=int, default=2_000_000)
    args = parser.parse_args()
    whole = city(args.points)
    cells = cells_of(whole)
    ours(2.0, cells[:1])  # kernels
    with tempfile.TemporaryDirectory() as folder:
        source = Path(__file__).with_name("layer_build_pcl.cpp")
        program = built_pcl_program(source, Path(folder), ("common", "kdtree", "search", "filters"))
        pcl = Pcl(program) if program else None
        print(f"load {os.getloadavg()[0]:.1f}; CPU ms, minimum of {args.rounds} rounds")
        if pcl is None:
            print("PCL: not measured, g++ or libpcl-dev is missing")
        for name, clouds, limit in (("one grid", [whole], 0.25), ("256 cells", cells, 0.7)):
            paths = []
            for number, cloud in enumerate(clouds):
                paths.append(Path(folder) / f"{number}.xyz")
                paths[-1].write_bytes(cloud.tobytes())
            for leaf in (1.0, 2.0):
                mine, theirs = [], []
                for _ in range(args.rounds):
                    mine.append(ours(leaf, clouds))
                    if pcl:
                        theirs.append(pcl.seconds(leaf, paths))
                points, took = sum(map(len, clouds)), min(mine)
                line = f"{name:10} {points:9,} points, leaf {leaf:g}: ours {took * 1e3:6.1f}"
                if theirs:
                    pcl_took, voxels = min(theirs)
                    line += f", PCL {pcl_took * 1e3:7.1f}, ratio {took / pcl_took:.3f} (limit {limit})"
                    line += f"; {voxels:,} voxels"
                print(line)
        if pcl:
            pcl.close()


if __name__ == "__main__":
    main()

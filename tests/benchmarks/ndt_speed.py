# SPDX-License-Identifier: Apache-2.0
"""Times alignments, and one evaluation beside PCL's in the same run.

    SHMMAP_TEST_DATA=DIR python -m tests.benchmarks.ndt_speed [--repeats 20]

CPU time, the minimum over repeats, one thread unless said.  PCL's part needs g++ and libpcl-dev.  Limits
on this class of machine: DIRECT7 pair 15 ms (ndt_omp: 67-78), working point 4 ms (Autoware: 22.7), an
evaluation at most 0.3 of PCL's, numpy at most 20 times numba at the working point, the first alignment of a
fresh process within 1 s once the kernels are cached.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from shmmap_clients.ndt_scan_matcher import NdtMatcher, Settings, VoxelMap, pose_from_matrix, voxel_cell

from tests.benchmarks.ndt_clouds import Pair, city, scan_pair
from tests.support.compiled_programs import PclNdt, build_pcl_ndt


def align_ms(
    pair: Pair, settings: Settings, repeats: int, *, backend: str = "numba", threads: int = 1
) -> str:
    """Return the least CPU and wall time of an alignment, and its iterations."""
    cpu, wall = [], []
    with NdtMatcher(settings, backend=backend, threads=threads) as matcher:
        matcher.set_map(VoxelMap({"map": voxel_cell(pair.target, pair.leaf)}))
        for _ in range(repeats):
            begin, began = time.process_time(), time.perf_counter()
            result = matcher.align(pair.source, pair.T_guess)
            wall.append(time.perf_counter() - began)
            cpu.append(time.process_time() - begin)
    return f"{min(cpu) * 1e3:8.2f} ms CPU {min(wall) * 1e3:8.2f} ms wall, {result.iterations} iterations"


def evaluation_ms(pair: Pair, repeats: int) -> tuple[float, float]:
    """Return the least CPU time of one evaluation in PCL's variant, and its score."""
    costs = []
    with NdtMatcher(Settings("pcl", "radius")) as matcher:
        matcher.set_map(VoxelMap({"map": voxel_cell(pair.target, pair.leaf)}))
        pose = pose_from_matrix(pair.T_guess)[None]
        for _ in range(repeats):
            begin = time.process_time()
            (at,) = matcher.evaluate(pair.source, pose)
            costs.append(time.process_time() - begin)
    return min(costs) * 1e3, at.score


FIRST = """
import time
began = time.perf_counter()
import sys, numpy as np
from shmmap_clients.ndt_scan_matcher.cli.machine import warmup_alignment
warmup_alignment()
print(time.perf_counter() - began)
"""


def first_alignment_s() -> float:
    """Return seconds from an empty interpreter to the first result, the least of five processes."""
    runs = [
        subprocess.run([sys.executable, "-c", FIRST], capture_output=True, text=True, check=True)
        for _ in range(6)
    ]
    return min(float(run.stdout) for run in runs[1:])  # the first may have compiled


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=20)
    args = parser.parse_args()
    pair, town = scan_pair(), city()
    print(f"load {os.getloadavg()[0]:.2f}, {os.cpu_count()} processors")
    for search in ("direct7", "direct1", "radius"):
        settings = Settings("pclomp", search, epsilon=0.1)
        print(f"pair, {search:8} 1 thread  {align_ms(pair, settings, args.repeats)}")
    two = align_ms(pair, Settings("pclomp", "direct7", epsilon=0.1), args.repeats, threads=2)
    print(f"pair, direct7  2 threads {two}")
    for backend, threads in (("numba", 1), ("numba", 2), ("numpy", 1)):
        took = align_ms(town, Settings(), args.repeats, backend=backend, threads=threads)
        print(f"working point, {backend}, {threads} thread(s) {took}")
    print(f"first alignment of a fresh process, kernels cached: {first_alignment_s():.2f} s")
    with tempfile.TemporaryDirectory() as folder:
        program = build_pcl_ndt(Path(folder))
        if program is None:
            print("PCL: not measured, g++ or libpcl-dev is missing")
            return
        for cloud in (pair, town):
            ours, score = evaluation_ms(cloud, args.repeats)
            with PclNdt(program, cloud.target, cloud.source, cloud.leaf) as pcl:
                theirs = pcl.evaluate(pose_from_matrix(cloud.T_guess), args.repeats)
            print(
                f"one evaluation, {cloud.name:9} PCL {theirs.ms:7.3f} ms, ours {ours:7.3f} ms, ratio"
                f" {ours / theirs.ms:.3f}; scores {theirs.score:.4f} and {score:.4f}"
            )


if __name__ == "__main__":
    main()

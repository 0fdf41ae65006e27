# SPDX-License-Identifier: Apache-2.0
"""What a map costs on an OpenCL device: writing it, moving it, reading it in place; and a fresh process.

    python -m tests.benchmarks.ndt_devices [--repeats 30]

A generated map of 64 000 voxels of 2 m in cells of 20 m, on the first device.  Limits, for PoCL on this class of
machine: whole map 3 ms; 20 m on 2 ms and 200 kB; in place 64 kB of private memory; taking a prepared map
0.1 ms; first evaluation of a fresh process 0.3 s once its program is in the driver's cache; 40 MB private.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from typing import Any

import numpy as np
from shmmap_clients.ndt_scan_matcher import DeviceOptions, Limits, VoxelCell, VoxelMap, voxel_cell
from shmmap_clients.ndt_scan_matcher.backends.opencl_backend import OpenclBackend

from shmmap.demo.process_memory import process_memory

HOW: dict[str, Any] = {"neighbors": "radius", "covariance": "autoware"}
_ACROSS = 18  # cells
_EDGE_M = 20.0
_POSE = np.array([180.0, 180.0, 1.5, 0.0, 0.0, 0.3])

FIRST = """
import os, time
from shmmap.demo.process_memory import process_memory
import numpy as np
import shmmap_clients.ndt_scan_matcher.matching.matcher
before = process_memory(os.getpid()).private_bytes
begin = time.perf_counter()
from shmmap_clients.ndt_scan_matcher.backends.registry import backend_named
from shmmap_clients.ndt_scan_matcher import Limits, VoxelMap
backend = backend_named("opencl", Limits())
backend.set_source(np.zeros((1500, 3)))
backend.evaluate(np.zeros(6), neighbors="radius", covariance="autoware")
print(time.perf_counter() - begin, process_memory(os.getpid()).private_bytes - before)
"""


def cells() -> dict[tuple[int, int], VoxelCell]:
    """Ground, and walls of 20 m along each cell's borders: about 200 voxels a cell."""
    rng = np.random.default_rng(1)
    flat = np.stack([*rng.uniform(0, _EDGE_M, (2, 4000)), rng.normal(0, 0.02, 4000)], axis=1)
    wall = np.stack(
        [rng.uniform(0, _EDGE_M, 4000), rng.normal(3, 0.1, 4000), rng.uniform(0, 20, 4000)], axis=1
    )
    cell = np.concatenate([flat, wall, wall[:, [1, 0, 2]]])
    return {
        (i, j): voxel_cell(cell + [i * _EDGE_M, j * _EDGE_M, 0.0], 2.0)
        for i in range(_ACROSS + 1)
        for j in range(_ACROSS)
    }


def least_ms(work: Any, prepare: Any, repeats: int) -> float:
    """The least time of ``work``, with what ``prepare`` returns."""
    took = []
    for _ in range(repeats):
        given = prepare()
        begin = time.perf_counter()
        work(given)
        took.append((time.perf_counter() - begin) * 1e3)
    return min(took)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=30)
    args = parser.parse_args()
    all_cells = cells()
    here = {str(key): cell for key, cell in all_cells.items() if key[0] < _ACROSS}
    ahead = {str(key): cell for key, cell in all_cells.items() if key[0] > 0}
    first = VoxelMap(here)
    print(f"load {os.getloadavg()[0]:.2f}; {first.voxels} voxels in {len(first.cells)} cells")
    scan = np.random.default_rng(2).uniform(-40, 40, (1500, 3))
    for memory in ("copy", "svm"):
        options = DeviceOptions(memory=memory)  # type: ignore[arg-type]
        backend = OpenclBackend(Limits(), options=options)
        backend.set_source(scan)
        backend.evaluate(_POSE, **HOW)  # builds the program
        statistics = backend.pool.statistics
        before, written = process_memory(os.getpid()).private_bytes, statistics.written_bytes
        backend.prepare(first, **HOW)
        grown = process_memory(os.getpid()).private_bytes - before
        print(
            f"{backend.device.info.name}, {memory}: the whole map: {statistics.written_bytes - written} bytes"
            f" written, {grown / 1e3:.0f} kB of private memory more"
        )

        def fresh() -> tuple[OpenclBackend, VoxelMap]:
            return OpenclBackend(Limits(), options=options), VoxelMap(here)  # noqa: B023

        whole = least_ms(lambda given: given[0].pool.prepare(given[1], "autoware"), fresh, args.repeats)
        backend.set_map(first)
        backend.evaluate(_POSE, **HOW)
        moved = VoxelMap(ahead, previous=first)
        written, writes = statistics.written_bytes, statistics.writes
        begin = time.perf_counter()
        backend.prepare(moved, **HOW)
        move_ms = (time.perf_counter() - begin) * 1e3
        taken = []
        swap = [first, moved]
        for number in range(args.repeats):
            backend.prepare(swap[number % 2], **HOW)
            begin = time.perf_counter()
            backend.set_map(swap[number % 2])
            taken.append((time.perf_counter() - begin) * 1e3)
            backend.evaluate(_POSE, **HOW)

        def step() -> VoxelMap:
            nonlocal swap
            swap = swap[::-1]
            backend.set_map(swap[1])  # noqa: B023
            backend.evaluate(_POSE, **HOW)  # noqa: B023
            # maps of the same cells: what only the other one has is written again
            return VoxelMap(swap[0].cells)

        again = least_ms(lambda given: backend.prepare(given, **HOW), step, args.repeats)  # noqa: B023
        print(
            f"{memory}: whole map {whole:.2f} ms; 20 m on {min(move_ms, again):.2f} ms,"
            f" {statistics.written_bytes} bytes in all, first step"
            f" {(statistics.writes - writes)} writes; set_map {max(taken):.4f} ms at most"
        )
        backend.close()
    runs = []
    for _ in range(6):
        done = subprocess.run([sys.executable, "-c", FIRST], capture_output=True, text=True, check=True)
        seconds, private = done.stdout.split()
        runs.append((float(seconds), int(private)))
    seconds, private = min(runs[1:])  # the first may have built the program
    print(f"fresh process: first evaluation after {seconds:.2f} s, {private / 1e6:.1f} MB private")


if __name__ == "__main__":
    main()

# SPDX-License-Identifier: Apache-2.0
"""What a map costs on an OpenCL device: writing it, moving it, reading it in place; and a fresh process.

    python -m tests.benchmarks.ndt_devices [--repeats 30]

A generated map of 60 000 voxels of 2 m in 400 cells of 20 m, on the first device; a step of a vehicle
brings 6 cells and takes 16, as Autoware's window did when it was measured.  Limits, for PoCL on this class of
machine: the whole map 3 ms, a step 2 ms and 200 kB, in place 64 kB written, taking a prepared map 0.1 ms, the
first evaluation of a fresh process 0.3 s once its program is in the driver's cache, and 40 MB private.
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
from shmmap_clients.ndt_scan_matcher.backends.opencl.devices import choose_device
from shmmap_clients.ndt_scan_matcher.backends.opencl_backend import OpenclBackend

from shmmap.demo.process_memory import process_memory

HOW: dict[str, Any] = {"neighbors": "radius", "covariance": "autoware"}
_ACROSS = 20  # cells
_NEW, _GONE = 6, 16  # cells of a step
_EDGE_M = 20.0
_POSE = np.array([200.0, 200.0, 1.5, 0.0, 0.0, 0.3])

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


def cells() -> dict[str, VoxelCell]:
    """Ground, and a wall along each cell's border: about 160 voxels a cell; more cells than the map has."""
    rng = np.random.default_rng(1)
    flat = np.stack([*rng.uniform(0, _EDGE_M, (2, 4000)), rng.normal(1.0, 0.02, 4000)], axis=1)
    x, z = rng.uniform(0, _EDGE_M, 2000), rng.uniform(0, 12, 2000)
    cell = np.concatenate([flat, np.stack([x, rng.normal(3, 0.1, 2000), z], axis=1)])
    return {
        f"{i}_{j}": voxel_cell(cell + np.array([i * _EDGE_M, j * _EDGE_M, 0.0]), 2.0)
        for i in range(_ACROSS + 1)
        for j in range(_ACROSS)
    }


def measure(memory: str, here: VoxelMap, ahead: VoxelMap, repeats: int) -> None:
    """Print what a whole map, steps to and fro, and taking a map cost one way to read it."""
    options = DeviceOptions(memory=memory)  # type: ignore[arg-type]
    backend = OpenclBackend(Limits(), options=options)
    backend.set_source(np.random.default_rng(2).uniform(-40, 40, (1500, 3)))
    backend.evaluate(_POSE, **HOW)  # builds the program
    statistics = backend.pool.statistics
    private, written = process_memory(os.getpid()).private_bytes, statistics.written_bytes
    begin = time.perf_counter()
    backend.prepare(here, **HOW)
    first_ms = (time.perf_counter() - begin) * 1e3
    private = process_memory(os.getpid()).private_bytes - private
    written = statistics.written_bytes - written
    whole: list[float] = []
    taking: list[float] = []
    steps: list[float] = []
    sizes: list[int] = []
    for number in range(2 * repeats):
        if number % 2 == 0:
            # everything is given up, then the whole map comes at once
            nothing = VoxelMap({})
            backend.prepare(nothing, **HOW)
            backend.set_map(nothing)
            backend.evaluate(_POSE, **HOW)
            backend.prepare(VoxelMap({}), **HOW)
        # as the updater makes the next map: beside the last one
        last = ahead if number % 2 == 0 else here
        voxel_map = VoxelMap((here if last is ahead else ahead).cells, previous=last)
        before = statistics.written_bytes
        begin = time.perf_counter()
        backend.prepare(voxel_map, **HOW)
        (steps if number % 2 else whole).append((time.perf_counter() - begin) * 1e3)
        if number % 2:
            sizes.append(statistics.written_bytes - before)
        begin = time.perf_counter()
        backend.set_map(voxel_map)
        taking.append((time.perf_counter() - begin) * 1e3)
        backend.evaluate(_POSE, **HOW)
    print(
        f"{memory}: {written / 1e6:.2f} MB written for the whole map, {private / 1e3:.0f} kB of private"
        f" memory more, {first_ms:.2f} ms at first, {min(whole):.2f} ms later; a step {min(steps):.2f} ms,"
        f" {max(sizes) / 1e3:.0f} kB; taking a map {max(taking):.4f} ms at most"
    )
    backend.close()


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=30)
    args = parser.parse_args()
    made = cells()
    inside = list(made)[: _ACROSS * _ACROSS]
    here = VoxelMap({key: made[key] for key in inside})
    ahead = VoxelMap({key: made[key] for key in [*inside[_GONE:], *list(made)[len(inside) :][:_NEW]]})
    device = choose_device(DeviceOptions()).info
    print(f"load {os.getloadavg()[0]:.2f}; {device.name}; {here.voxels} voxels in {len(here.cells)} cells")
    for memory in ("copy", "svm"):
        measure(memory, here, ahead, args.repeats)
    runs = []
    for _ in range(6):
        done = subprocess.run([sys.executable, "-c", FIRST], capture_output=True, text=True, check=True)
        seconds, private = done.stdout.split()
        runs.append((float(seconds), int(private)))
    least_s, most_bytes = min(runs[1:])  # the first may have built the program
    print(f"fresh process: first evaluation after {least_s:.2f} s, {most_bytes / 1e6:.1f} MB private")


if __name__ == "__main__":
    main()

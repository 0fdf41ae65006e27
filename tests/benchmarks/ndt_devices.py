# SPDX-License-Identifier: Apache-2.0
"""What a map costs on an OpenCL device: writing it, moving it, reading it in place; and a fresh process.

    python -m tests.benchmarks.ndt_devices [--repeats 30]

A generated map of 60 000 voxels of 2 m in 400 cells of 20 m, on the first device; a step of a vehicle
brings 6 cells and takes 16, as Autoware's window did when it was measured.  Printed are the least of all
repeats, the median, and the median of CPU time.  Limits, for PoCL on this class of machine: the whole map
3 ms, and so a step, which writes all of the next map beside the one in use; in place 64 kB of private memory
more, with the first evaluation; taking a prepared map 0.1 ms; the first evaluation of a fresh process 0.3 s
once its program is in the driver's cache, and 40 MB of its own memory (64 MB of the driver's files are shared
by all processes).

Measured beside those of BENCHMARKS.md, the least of 30 on a busy machine: read in place 12 to 16 kB of
private memory, 1.6 ms to get a map ready, 0.2 ms a step; taking a prepared map less than 0.01 ms.
"""

from __future__ import annotations

import argparse
import gc
import os
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from statistics import median

import numpy as np
from shmmap_clients.ndt_scan_matcher import DeviceOptions, Limits, Scoring, VoxelCell, VoxelMap, voxel_cell
from shmmap_clients.ndt_scan_matcher.backends.opencl.devices import choose_device
from shmmap_clients.ndt_scan_matcher.backends.opencl_backend import OpenclBackend

from tests.support.process_costs import anonymous_bytes

HOW = Scoring("radius", "autoware")
_ACROSS = 20  # cells
_NEW, _GONE = 6, 16  # cells of a step
_EDGE_M = 20.0
_POSE = np.array([200.0, 200.0, 1.5, 0.0, 0.0, 0.3])

FIRST = """
import os, time
import numpy as np
import shmmap_clients.ndt_scan_matcher.matching.matcher
from tests.support.process_costs import anonymous_bytes
before = anonymous_bytes(os.getpid())
begin = time.perf_counter()
from shmmap_clients.ndt_scan_matcher.backends.registry import backend_named
from shmmap_clients.ndt_scan_matcher import Limits, Scoring
backend = backend_named("opencl", Limits())
backend.set_source(np.zeros((1500, 3)))
backend.evaluate(np.zeros((1, 6)), Scoring("radius", "autoware"))
print(time.perf_counter() - begin, anonymous_bytes(os.getpid()) - before)
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


def ready(memory: str, some: VoxelMap) -> OpenclBackend:
    """Return a backend that has evaluated: its program is built, the driver's threads have started."""
    backend = OpenclBackend(Limits(), options=DeviceOptions(memory=memory))  # type: ignore[arg-type]
    backend.set_source(np.random.default_rng(2).uniform(-40, 40, (1500, 3)))
    backend.prepare(some, HOW)
    backend.set_map(some)
    backend.evaluate(_POSE[None], HOW)
    return backend


class Costs:
    """Wall time and CPU time of the whole process, milliseconds."""

    def __init__(self) -> None:
        self._ms: list[tuple[float, float]] = []

    def take(self, work: Callable[[], object]) -> None:
        """Do something and note what it costs."""
        cpu, wall = time.process_time(), time.perf_counter()
        work()
        self._ms.append(((time.perf_counter() - wall) * 1e3, (time.process_time() - cpu) * 1e3))

    def __str__(self) -> str:
        wall, cpu = zip(*self._ms, strict=True)
        return f"{min(wall):.2f} ms (median {median(wall):.2f}, {median(cpu):.2f} of a processor)"


def measure(memory: str, made: dict[str, VoxelCell], repeats: int) -> None:
    """Print what a whole map, steps to and fro, and taking a map cost with one kind of memory."""
    inside = list(made)[: _ACROSS * _ACROSS]
    here = VoxelMap({key: made[key] for key in inside})
    ahead = VoxelMap({key: made[key] for key in [*inside[_GONE:], *list(made)[len(inside) :][:_NEW]]})
    some = VoxelMap({key: made[key] for key in inside[:5]})
    backend = ready(memory, some)
    gc.collect()
    private, written = anonymous_bytes(os.getpid()), backend.uploads.written_bytes
    backend.prepare(here, HOW)
    backend.set_map(here)
    backend.evaluate(_POSE[None], HOW)
    private = anonymous_bytes(os.getpid()) - private
    written = backend.uploads.written_bytes - written
    backend.close()
    fresh, whole, step, taking = Costs(), Costs(), Costs(), Costs()
    for _ in range(repeats):
        backend = ready(memory, some)
        last = VoxelMap(here.cells)
        fresh.take(partial(backend.prepare, last, HOW))
        backend.close()
    backend = ready(memory, some)
    sizes: list[int] = []
    for number in range(2 * repeats):
        if number % 2 == 0:
            # everything is given up, then the whole map comes at once
            nothing = VoxelMap({})
            backend.prepare(nothing, HOW)
            backend.set_map(nothing)
            backend.evaluate(_POSE[None], HOW)
            backend.prepare(VoxelMap({}), HOW)
            last = VoxelMap(here.cells)
            whole.take(partial(backend.prepare, last, HOW))
        else:
            # as the updater makes the next map: beside the last one
            before = backend.uploads.written_bytes
            last = VoxelMap(ahead.cells, previous=last)
            step.take(partial(backend.prepare, last, HOW))
            sizes.append(backend.uploads.written_bytes - before)
        taking.take(partial(backend.set_map, last))
        backend.evaluate(_POSE[None], HOW)
    print(
        f"{memory}: {here.voxels} voxels in {len(here.cells)} cells; {written / 1e6:.2f} MB written, private"
        f" memory grows by {private / 1e3:.0f} kB\n"
        f"  whole map, memory never used: {fresh}\n  whole map, later: {whole}\n"
        f"  step: {step}, {max(sizes) / 1e3:.0f} kB\n  taking a map: {taking}"
    )
    backend.close()


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=30)
    parser.add_argument("--memory", choices=("copy", "svm"), help="only this one, in this process")
    args = parser.parse_args()
    if args.memory:
        measure(args.memory, cells(), args.repeats)
        return
    device = choose_device(DeviceOptions()).info
    print(f"load {os.getloadavg()[0]:.2f}; {device.name}", flush=True)
    for memory in ("copy", "svm"):
        # in a process of its own: memory that another one has given back is no growth
        words = ["-m", "tests.benchmarks.ndt_devices", "--memory", memory, "--repeats", str(args.repeats)]
        subprocess.run([sys.executable, *words], check=True)
    runs = []
    for _ in range(6):
        done = subprocess.run([sys.executable, "-c", FIRST], capture_output=True, text=True, check=True)
        seconds, private = done.stdout.split()
        runs.append((float(seconds), int(private)))
    seconds_, bytes_ = zip(*runs[1:], strict=True)  # the first may have built the program
    print(
        f"fresh process: first evaluation after {min(seconds_):.2f} s, {max(bytes_) / 1e6:.1f} MB of its own"
    )


if __name__ == "__main__":
    main()

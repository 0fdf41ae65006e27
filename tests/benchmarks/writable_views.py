# SPDX-License-Identifier: Apache-2.0
"""Eight processes with a hundred writes each through `Cell.to_open3d`, and `Cell.to_torch` where torch is.

Each process compares the cell with its checksums after every write, and so does this one at the end: none may
end by a signal, none may see a byte of what another one wrote.

    python -m tests.benchmarks.writable_views
"""

from __future__ import annotations

import argparse
import importlib.util
import subprocess
import sys

import numpy as np

from shmmap.segment.attach import attach
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.header import PublishBlock
from tests.support.segments import publish_segment

WRITES = {
    "open3d": (
        "cloud = cell.to_open3d(); cloud.translate([i, 0, 0]).scale(2.0, [0, 0, 0]);"
        " cloud.point['intensity'][:] = i"
    ),
    "torch": "tensors = cell.to_torch(); tensors['xyz'] += i; tensors['intensity'].zero_()",
}

PROGRAM = """
import sys
from shmmap.client.attaching import Attacher
from shmmap.client.cell import Access
from shmmap.protocol.messages import Handle
name, nbytes, points = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
handle = Handle("/cell", 1, "points", name, 0, nbytes, points, 0.0, 0.0, 20.0, 20.0)
cell = Attacher().attach(handle, "/cell", name, Access("/dev/shm", 5, None))
for i in range(int(sys.argv[4])):
    {write}
    cell.verify()
"""


def main() -> int:
    """Write and print; 1 if a process did not end by itself, or the cell changed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--processes", type=int, default=8)
    parser.add_argument("--writes", type=int, default=100)
    parser.add_argument("--points", type=int, default=100_000)
    args = parser.parse_args()
    rng = np.random.default_rng(1)
    columns = {
        "xyz": rng.random((args.points, 3), np.float32),
        "intensity": rng.random(args.points, np.float32),
    }
    directory = ShmDirectory()
    name, header = publish_segment(directory, columns, block=PublishBlock(1, 1), instance="benchmark")
    bad = False
    try:
        for library, write in WRITES.items():
            if importlib.util.find_spec(library) is None:
                print(f"{library}: not installed")
                continue
            command = [sys.executable, "-c", PROGRAM.format(write=write), name]
            command += [str(header.total_bytes), str(args.points), str(args.writes)]
            running = [subprocess.Popen(command) for _ in range(args.processes)]
            codes = [process.wait() for process in running]
            attach(name).verify()
            bad = bad or any(codes)
            ends = ", ".join(map(str, sorted(set(codes))))
            print(f"{library}: {len(codes)} processes, {args.writes} writes each, exit codes {ends}")
    finally:
        directory.unlink(name)
        directory.close()
    return int(bad)


if __name__ == "__main__":
    sys.exit(main())

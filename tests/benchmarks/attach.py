# SPDX-License-Identifier: Apache-2.0
"""Cost of attaching a cell.

Attaching includes the open, the session's lock, the mapping, the header's checksum and the cell object
with its coordinates and one more column; what it is compared with: ``posix_ipc`` and ``mmap`` bare.

    python -m tests.benchmarks.attach [--cells 500] [--rounds 20] [--points 20000]
"""

from __future__ import annotations

import argparse
import mmap
import statistics
import time

import numpy as np
import posix_ipc

from shmmap.client.attaching import Attacher
from shmmap.client.cell import Access, Cell
from shmmap.protocol.messages import Handle
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.header import PublishBlock
from shmmap.segment.names import DEFAULT_SHM_DIR
from tests.support.segments import publish_segment


def publish(directory: ShmDirectory, number: int, points: int) -> tuple[str, Handle]:
    """Make one published segment of random points, as the daemon does."""
    rng = np.random.default_rng(number)
    box = (20.0 * number, 0.0, 20.0 * number + 20, 20.0)
    cell_id = f"/maps/town/pointcloud_map.pcd/{20 * number}_0.pcd"
    columns = {"xyz": rng.random((points, 3), np.float32), "intensity": rng.random(points, np.float32)}
    name, header = publish_segment(
        directory, columns, block=PublishBlock(1, number), instance="benchmark", cell_id=cell_id, box=box
    )
    return name, Handle(cell_id, number, "points", name, 0, header.total_bytes, points, *box)


def time_cells(segments: list[tuple[str, Handle]]) -> list[int]:
    """Attach every segment once; nanoseconds each."""
    attacher, access = Attacher(), Access(DEFAULT_SHM_DIR, 0x1234_5678_9ABC, None)
    kept: list[Cell] = []
    took = []
    for name, handle in segments:
        began = time.perf_counter_ns()
        cell = attacher.attach(handle, handle.id, name, access)
        cell.xyz, cell["intensity"]
        took.append(time.perf_counter_ns() - began)
        kept.append(cell)
    return took


def time_bare(segments: list[tuple[str, Handle]]) -> list[int]:
    """Open and map every segment with posix_ipc and mmap, one array each; nanoseconds each."""
    kept = []
    took = []
    for name, _ in segments:
        began = time.perf_counter_ns()
        shm = posix_ipc.SharedMemory(name, read_only=True)
        mapping = mmap.mmap(shm.fd, 0, prot=mmap.PROT_READ)
        shm.close_fd()
        array = np.frombuffer(mapping, np.float32)
        took.append(time.perf_counter_ns() - began)
        kept.append((mapping, array))
    return took


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--cells", type=int, default=500)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--points", type=int, default=20_000)
    args = parser.parse_args()
    directory = ShmDirectory()
    segments = [publish(directory, number, args.points) for number in range(1, args.cells + 1)]
    try:
        cells: list[int] = []
        bare: list[int] = []
        for _ in range(args.rounds):
            cells += time_cells(segments)
            bare += time_bare(segments)
    finally:
        for name, _ in segments:
            directory.unlink(name)
        directory.close()
    ours_us, bare_us = statistics.median(cells) / 1e3, statistics.median(bare) / 1e3
    print(
        f"attach a cell: median {ours_us:.1f} us, p99 {np.percentile(cells, 99) / 1e3:.1f} us;"
        f" posix_ipc and mmap alone: median {bare_us:.1f} us; ratio {ours_us / bare_us:.2f}"
    )


if __name__ == "__main__":
    main()

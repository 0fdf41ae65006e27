# SPDX-License-Identifier: Apache-2.0
"""What N processes cost that hold the same part of a map: shared by shmmap, and each with its own copy.

    python -m tests.benchmarks.memory [--processes 8] [--megabytes 100]

Real processes, memory from /proc/PID/smaps_rollup (proportional set size).  The peers read the same
PCD files into arrays of their own.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path

from tests.support.client_programs import FollowingClient
from tests.support.daemon_process import DaemonProcess, LineProcess
from tests.support.divided_map import DividedMap, make_map
from tests.support.process_costs import proportional_bytes, proportional_bytes_under

_PRIVATE = """
import sys
from pathlib import Path
from shmmap.formats.cloud import read_pcd
sys.stdin.readline()
clouds = [read_pcd(path).columns for path in sorted(Path(sys.argv[1]).glob("*.pcd"))]
print(sum(len(c["xyz"]) for c in clouds), flush=True)
sys.stdin.read()
"""


def shared(made: DividedMap, count: int) -> tuple[list[int], list[int], list[int], int]:
    """Per process: PSS before, PSS while holding all, its part in segments; and one copy's bytes."""
    one = DaemonProcess(made.root, "--budget", "4G").start()
    clients = [FollowingClient(one.endpoint, "area") for _ in range(count)]
    try:
        x, y = made.corners[next(iter(made.corners))]
        for client in clients:
            client.ask(x + 1.0, y + 1.0, 0.0)
            client.answer()
        before = [proportional_bytes(c.process.pid) for c in clients]
        for client in clients:
            client.ask(0.0, 0.0, 1e6)
        for client in clients:
            client.answer()
        held = [proportional_bytes(c.process.pid) for c in clients]
        inside = [proportional_bytes_under(c.process.pid, one.shm_dir) for c in clients]
        return before, held, inside, one.segment_bytes()
    finally:
        for client in clients:
            client.kill()
        one.stop()
        one.dispose()


def private(made: DividedMap, count: int) -> list[int]:
    """PSS of processes that read the files themselves."""
    with ExitStack() as stack:
        processes = [
            stack.enter_context(LineProcess(sys.executable, "-c", _PRIVATE, str(made.pcd_dir)))
            for _ in range(count)
        ]
        for process in processes:
            process.write()
        for process in processes:
            process.read()
        return [proportional_bytes(process.pid) for process in processes]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--processes", type=int, default=8)
    parser.add_argument("--megabytes", type=int, default=100)
    arguments = parser.parse_args()
    count = arguments.processes
    with tempfile.TemporaryDirectory() as directory:
        points = arguments.megabytes * (1 << 20) // 16 // 64 + 1
        made = make_map(Path(directory) / "map", columns=8, rows=8, points=points)
        before, held, inside, copy = shared(made, count)
        own = private(made, count)
    rows = [
        ("one copy in shared memory", copy, ""),
        (f"{count} processes, shared: the segments", sum(inside), f"{sum(inside) / copy:.3f} copies"),
        (
            f"{count} processes, shared: what holding adds",
            sum(held) - sum(before),
            f"{(sum(held) - sum(before)) / copy:.3f} copies",
        ),
        (f"{count} processes, shared: everything", sum(held), ""),
        ("an interpreter with its libraries", statistics.median(before), "each"),
        (f"{count} processes, own copies", sum(own), f"{sum(own) / sum(held):.2f} x shared"),
    ]
    for name, nbytes, note in rows:
        print(f"{name:40} {nbytes / (1 << 20):9.1f} MiB  {note}")


if __name__ == "__main__":
    main()

# SPDX-License-Identifier: Apache-2.0
"""Warm requests while every cell's layers are being built, against the same daemon idle.

    python -m tests.benchmarks.layers_beside_requests [--cells 400] [--points 20000]

One client asks again and again for a warm window (differential, nothing new); another has asked for
``ndt`` and ``voxel`` layers of the whole map.  Limit: p99 at most 3 times that of the idle daemon, whose
requests are timed before and after: where these two differ the machine is busy with something else.
"""

from __future__ import annotations

import argparse
import math
import os
import tempfile
import time
from pathlib import Path

import numpy as np

from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import make_map
from tests.support.raw_client import RawClient, circle, pack_versions

LAYERS = ["ndt(leaf=2.0)", "voxel(leaf=0.2)"]


def timed(client: RawClient, packed: bytes) -> float:
    """Microseconds of one warm request."""
    began = time.perf_counter()
    client.ask("differential", circle(0.0, 0.0, 100.0), ["points"], [], packed, None, None)
    return (time.perf_counter() - began) * 1e6


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--cells", type=int, default=400)
    parser.add_argument("--points", type=int, default=20_000)
    parser.add_argument("--workers", type=int, default=0)
    args = parser.parse_args()
    side = math.isqrt(args.cells)
    with tempfile.TemporaryDirectory() as folder:
        made = make_map(Path(folder) / "map", columns=side, rows=side, points=args.points)
        flags = ["--cache-size", "0", *(["--workers", str(args.workers)] if args.workers else [])]
        daemon = DaemonProcess(made.root, *flags).start()
        try:
            client, other = RawClient(daemon.endpoint), RawClient(daemon.endpoint)
            warm = client.area(circle(0.0, 0.0, 100.0))
            packed = pack_versions([handle.version for handle in warm.cells])
            other.ask("area", circle(0.0, 0.0, 1.0), LAYERS, 60.0, None)  # kernels
            idle = np.array([timed(client, packed) for _ in range(3000)])
            everything = ["box", -1e4, -1e4, 1e4, 1e4, None, None]
            request = other.send("area", everything, LAYERS, 300.0, None)
            busy = []
            while not other.readable():
                busy.append(timed(client, packed))
            reply = other.cells_reply(other.wait_for(request))
            after = np.array([timed(client, packed) for _ in range(3000)])
            for name, times in (
                ("idle, before", idle), ("while building", np.array(busy)), ("idle, after", after),
            ):  # fmt: skip
                p50, p99 = np.percentile(times, [50, 99])
                print(f"{name:15} {len(times):6,} requests: median {p50:5.0f} us, p99 {p99:5.0f} us")
            ratio = np.percentile(busy, 99) / np.percentile(np.concatenate([idle, after]), 99)
            print(
                f"load {os.getloadavg()[0]:.1f}; {len(reply.cells)} layers built,"
                f" {len(reply.failed)} failed; p99 ratio {ratio:.2f} (limit 3)"
            )
            client.close()
            other.close()
        finally:
            daemon.stop()
            daemon.dispose()


if __name__ == "__main__":
    main()

# SPDX-License-Identifier: Apache-2.0
"""A window of ndt layers from a warm daemon: the request, attaching, and touching every column.

    python -m tests.benchmarks.attach_layers [--rounds 20]

256 cells of 20 m.  Timed in fresh processes: `client.area` to the last attached cell, then the first
access to every column of every cell; beside it what Autoware does instead, the statistics from points.
Private memory is what the process's pages that nobody shares grew by.  Limits: 10 ms, 1 MB.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.support.daemon_process import ROOT, DaemonProcess
from tests.support.divided_map import make_map

_CLIENT = """
import gc, json, re, sys, time
import shmmap
def private():
    with open("/proc/self/smaps_rollup") as file:
        text = file.read()
    return sum(int(n) for n in re.findall(r"Private_(?:Clean|Dirty):\\s+(\\d+) kB", text))
with shmmap.connect(sys.argv[1]) as client:
    area = shmmap.Box(-159, -159, 159, 159)
    client.area(shmmap.Box(-1, -1, 1, 1), ["ndt(leaf=2.0)"])  # code, not data
    gc.collect()
    before = private()
    began = time.perf_counter()
    found = client.area(area, ["ndt(leaf=2.0)"])
    attached = time.perf_counter()
    total = 0
    for cell in found:
        for name in ("mean", "inverse_covariance", "table"):
            total += cell[name].size
    wrapped = time.perf_counter()
    print(json.dumps([len(found), (attached - began) * 1e3, (wrapped - began) * 1e3, private() - before]))
"""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--rounds", type=int, default=20)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        made = make_map(Path(folder) / "map", columns=16, rows=16, points=5000)
        daemon = DaemonProcess(
            made.root, environment={"NUMBA_CACHE_DIR": str(Path.home() / ".cache/shmmap/kernels")}
        ).start()
        try:
            command = [sys.executable, "-c", _CLIENT, daemon.endpoint]
            rows = []
            for number in range(args.rounds + 1):
                done = subprocess.run(
                    command,
                    capture_output=True,
                    text=True,
                    check=True,
                    env={**os.environ, "PYTHONPATH": str(ROOT)},
                )
                if number:  # the first one waited for the builds
                    rows.append(json.loads(done.stdout))
            print(
                f"load {os.getloadavg()[0]:.1f}; {rows[0][0]} cells; request and attach"
                f" {statistics.median(r[1] for r in rows):.2f} ms (least {min(r[1] for r in rows):.2f}),"
                f" with every column {statistics.median(r[2] for r in rows):.2f} ms"
                f" (least {min(r[2] for r in rows):.2f}, limit 10);"
                f" private memory {statistics.median(r[3] for r in rows):.0f} kB (limit 1000)"
            )
        finally:
            daemon.stop()
            daemon.dispose()


if __name__ == "__main__":
    main()

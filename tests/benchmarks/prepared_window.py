# SPDX-License-Identifier: Apache-2.0
"""A cold window of a prepared map against ``cp`` of the same bytes.

    python -m tests.benchmarks.prepared_window [--rounds 7] [--points 100000]

A map is prepared with ``points`` and ``ndt(leaf=2.0)``.  A daemon whose loaders have started already (on
cells elsewhere) is asked for a window of 64 cells in both layers: first request to last handle, against
``cp`` of the segments' bytes into the same shared-memory directory (4 KiB pages).  Rounds take turns; the
window is evicted after each.  Limit: 1.6.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.support.daemon_process import ROOT, DaemonProcess
from tests.support.divided_map import make_map
from tests.support.raw_client import RawClient

LAYERS = ["points", "ndt(leaf=2.0)"]
BOX = ["box", -79.0, -79.0, 79.0, 79.0, None, None]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--points", type=int, default=100_000)
    parser.add_argument("--workers", type=int, default=0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        cache = Path(folder) / "cache"
        made = make_map(Path(folder) / "map", columns=10, rows=8, points=args.points)
        subprocess.run(
            [
                sys.executable, "-m", "shmmap.cli", "prepare", str(made.root), "--cache-dir", str(cache),
                "--json", "--layer", *LAYERS,
            ],
            check=True, stdout=subprocess.DEVNULL, env={**os.environ, "PYTHONPATH": str(ROOT)},
        )  # fmt: skip
        flags = ["--cache-dir", str(cache), *(["--workers", str(args.workers)] if args.workers else [])]
        daemon = DaemonProcess(made.root, *flags).start()
        try:
            client = RawClient(daemon.endpoint)
            far = ["box", -100.0, -80.0, -81.0, 80.0, None, None]
            client.cells_reply(client.ask("area", far, LAYERS, 60.0, None))  # the loaders run
            ours, theirs = [], []
            for _ in range(args.rounds):
                began = time.perf_counter()
                reply = client.cells_reply(client.ask("area", BOX, LAYERS, 60.0, None))
                ours.append(time.perf_counter() - began)
                total = sum(handle.bytes for handle in reply.cells)
                copy = Path(folder) / "copy"
                target = Path(daemon.shm_dir) / "copied"
                if not copy.exists():
                    copy.mkdir()
                    for handle in reply.cells:
                        shutil.copy(client.path(handle), copy)
                began = time.perf_counter()
                subprocess.run(["cp", "-r", str(copy), str(target)], check=True)
                theirs.append(time.perf_counter() - began)
                shutil.rmtree(target)
                client.release()
                client.ask("evict", None)
            found = dict(client.ask("stats")[4])
            ratio = statistics.median(a / b for a, b in zip(ours, theirs, strict=True))
            print(
                f"load {os.getloadavg()[0]:.1f}; {len(reply.cells)} handles, {total / 1e6:.0f} MB;"
                f" layers computed: {found['layers_computed']}"
            )
            for name, times in (("cp", theirs), ("ours", ours)):
                print(
                    f"{name:5} median {statistics.median(times) * 1e3:5.0f} ms, least {min(times) * 1e3:5.0f}"
                )
            print(f"ratio {ratio:.2f}, of the least {min(ours) / min(theirs):.2f} (limit 1.6)")
            client.close()
        finally:
            daemon.stop()
            daemon.dispose()


if __name__ == "__main__":
    main()

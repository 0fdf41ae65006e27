# SPDX-License-Identifier: Apache-2.0
"""Compute layers of a published map on a dask cluster, slice by slice, and join them.

A slice is the command ``shmmap prepare URL --layer ... --shards I/N``, run by the next free worker; if a
worker is lost, another one computes its slice.  Workers need shmmap with its extra ``remote``, and the
store's credentials in their environment.

    python3 slices_with_dask.py s3://maps/town --layer 'ndt(leaf=2.0)' --slices 64 --scheduler tcp://HOST:8786
"""

from __future__ import annotations

import argparse
import json
import logging
import subprocess
import sys
from typing import Any

from dask.distributed import Client, as_completed


def prepare_slice(url: str, layers: list[str], number: int, slices: int) -> dict[str, Any]:
    """Compute one slice; return the report of `shmmap prepare`, which names the run."""
    done = subprocess.run(
        [
            *(sys.executable, "-m", "shmmap.cli", "prepare", url, "--layer", *layers),
            *("--shards", f"{number}/{slices}", "--workers", "1", "--json"),
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        raise RuntimeError(f"slice {number} of {slices}: {done.stderr}{done.stdout}")
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def prepare_on(client: Client, url: str, layers: list[str], slices: int) -> str:
    """Compute all slices on a cluster; return the name of the run."""
    # a slice has the same bytes on any worker, so that dask may repeat it
    futures = [
        client.submit(prepare_slice, url, layers, number, slices, retries=2, pure=False)
        for number in range(1, slices + 1)
    ]
    print(f"making {slices} slices; each is reported when it is done", flush=True)
    runs = set()
    for done, (future, made) in enumerate(as_completed(futures, with_results=True), 1):
        runs.add(made["run"])
        how = "was there" if made["there"] else f"{made['sent_bytes']:,} bytes sent, {made['seconds']:.0f} s"
        left = f"{slices - done} left" if done < slices else "all are made"
        print(f"slice {made['slice']} of {slices}: {made['cells']} cells, {how}; {left}", flush=True)
        future.release()
    (run,) = runs
    return str(run)


def main() -> int:
    """Compute all slices, then join them."""
    parser = argparse.ArgumentParser(description="Add layers to a published map, on a dask cluster.")
    parser.add_argument("url", metavar="URL", help="where the map is published")
    parser.add_argument("--layer", metavar="SPEC", nargs="+", required=True, help="such as 'ndt(leaf=2.0)'")
    parser.add_argument("--slices", metavar="N", type=int, default=8, help="how many slices (default: 8)")
    parser.add_argument("--scheduler", metavar="ADDRESS", help="of a cluster (default: start workers here)")
    parser.add_argument(
        "--workers", metavar="N", type=int, help="how many start here (default: one per core)"
    )
    args = parser.parse_args()
    if args.scheduler:
        client = Client(args.scheduler)
    else:
        # at the end dask warns of workers that it kills where they do not end within some seconds: no failure
        client = Client(
            n_workers=args.workers, threads_per_worker=1, dashboard_address=None, silence_logs=logging.ERROR
        )
    with client:
        run = prepare_on(client, args.url, args.layer, args.slices)
    join = [sys.executable, "-m", "shmmap.cli", "publish", args.url, "--join", run]
    return subprocess.run(join, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())

# SPDX-License-Identifier: Apache-2.0
"""What Autoware's scan matcher gets from shared memory, in C++: voxel leaves and points of a whole street.

    SHMMAP_TEST_DATA=DIR python -m tests.benchmarks.ndt_leaves [--rounds 40]

One thread; in each round, in turns: ``shmmap::ndt_leaves`` of the mapped ``ndt`` layers of all cells beside
PCL's voxel grid of their points (processor time); a whole request to ``NdtLeaves`` and to ``PcdLoader``, all
cells, until it is answered, beside PCL reading the same cells' files, which are in the page cache (elapsed).
Limit: 0.5 ms for the leaves.  Needs g++ and libpcl-dev.

Measured beside those of BENCHMARKS.md: a request of Autoware's scan matcher for all 59 cells, none held,
takes 2.9 ms with leaves and 33 ms with points; PCL reads the points' files from the page cache in 40 ms.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
from pathlib import Path

from shmmap.dividing.divide import divide
from tests.benchmarks.street_data import street
from tests.support.compiled_programs import PclLeaves, build_pcl_leaves
from tests.support.daemon_process import DaemonProcess

LIMIT_MS = 0.5
LEAF_M = 2.0


def main() -> None:
    """Measure and print; exit code 1 where the limit does not hold, or nothing can be measured."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=40)
    args = parser.parse_args()
    map_file = street().map_file
    with tempfile.TemporaryDirectory() as folder:
        program = build_pcl_leaves(Path(folder), optimize="-O3")
        if program is None:
            sys.exit("not measured: g++ or libpcl-dev is missing")
        divide([map_file], Path(folder) / "map")
        with (
            DaemonProcess(Path(folder) / "map") as daemon,
            PclLeaves(program, daemon.endpoint, LEAF_M) as leaves,
        ):
            leaves.time()  # memory that no program has yet
            rows = [leaves.time() for _ in range(args.rounds)]
    first = rows[0]
    print(
        f"load {os.getloadavg()[0]:.1f}; {first['cells']} cells, {first['leaves']:,} leaves of"
        f" {first['bytes'] / 1e6:.2f} MB; medians of {args.rounds} rounds (least)"
    )

    def spread(name: str) -> str:
        times = [row[name] for row in rows]
        return f"{statistics.median(times):.2f} ms ({min(times):.2f})"

    def ratio(ours: str, theirs: str) -> float:
        return float(statistics.median(row[ours] / row[theirs] for row in rows))

    took = statistics.median(row["ours_ms"] for row in rows)
    holds = took <= LIMIT_MS
    print(
        f"leaves of the layer: {spread('ours_ms')}; PCL's voxel grid: {spread('pcl_ms')};"
        f" ratio {ratio('ours_ms', 'pcl_ms'):.4f}; limit {LIMIT_MS} ms: {'holds' if holds else 'EXCEEDED'}"
    )
    print(
        f"a request for all leaves: {spread('leaves_ms')}; for all points: {spread('points_ms')};"
        f" PCL reads the files: {spread('files_ms')}; ratio {ratio('points_ms', 'files_ms'):.2f}"
    )
    if not holds:
        sys.exit(1)


if __name__ == "__main__":
    main()

# SPDX-License-Identifier: Apache-2.0
"""`shmmap divide` of a large generated cloud against ``cp`` and ``fsync`` of the same bytes.

    python -m tests.benchmarks.divide_large [--points 2e8] [--max-memory 1G] [--fields xyzi|xyzircaedt]
        [--random] [--repeat 3] [--dir DIR]

The cloud is what a mapping drive gives: points around a moving vehicle, in the order of time;
``--random`` shuffles all order out of it, the worst case.  Both programs run in turn, each on the same
cached input, each with the disk synced and nothing left to write before it starts.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from shmmap.formats.pcd.writer import pcd_header

FIELDS = {
    "xyzi": [(name, "<f4") for name in ("x", "y", "z", "intensity")],
    "xyzircaedt": [
        ("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "u1"), ("return_type", "u1"),
        ("channel", "<u2"), ("azimuth", "<f4"), ("elevation", "<f4"), ("distance", "<f4"),
        ("time_stamp", "<u4"),
    ],
}  # fmt: skip
BLOCK = 1 << 20


def generate(path: Path, points: int, row: np.dtype[np.void], *, random: bool) -> None:
    """Write the cloud, a block at a time."""
    rng = np.random.default_rng(1)
    block = np.zeros(BLOCK, row)
    with path.open("wb") as file:
        file.write(pcd_header([(name, row[name], 1) for name in row.names or ()], points, "binary"))
        for start in range(0, points, BLOCK):
            count = min(BLOCK, points - start)
            phase = np.arange(start, start + count) / points * 2 * np.pi
            near = rng.normal(0.0, 25.0, (3, count)).astype(np.float32)
            if random:
                block["x"][:count] = rng.uniform(-1000, 1000, count)
                block["y"][:count] = rng.uniform(-1000, 1000, count)
            else:
                block["x"][:count] = 900 * np.cos(phase) + near[0]
                block["y"][:count] = 900 * np.sin(2 * phase) + near[1]
            block["z"][:count] = near[2] / 10
            block["intensity"][:count] = np.arange(count) % 251
            file.write(block[:count].tobytes())
        file.flush()
        os.fsync(file.fileno())


def processor_s() -> float:
    """Processor time of all programs run so far: what a busy machine leaves comparable."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def copy(source: Path, target: Path) -> float:
    """Seconds of ``cp`` and of forcing the copy to the disk."""
    began = time.perf_counter()
    subprocess.run(["cp", "--reflink=never", str(source), str(target)], check=True)
    subprocess.run(["sync", str(target)], check=True)
    return time.perf_counter() - began


def main() -> None:
    """Generate, run both in turn, print the ratio."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--points", type=float, default=2e8)
    parser.add_argument("--max-memory", default="1G")
    parser.add_argument("--fields", choices=tuple(FIELDS), default="xyzi")
    parser.add_argument("--random", action="store_true")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--dir", default=None, help="where the files go (default: the temporary directory)")
    parser.add_argument("options", nargs="*", help="further options of divide, after --")
    args = parser.parse_args()
    points, row = int(args.points), np.dtype(FIELDS[args.fields])
    work = Path(tempfile.mkdtemp(prefix="divide_large-", dir=args.dir))
    try:
        cloud = work / "cloud.pcd"
        generate(cloud, points, row, random=args.random)
        size = cloud.stat().st_size
        print(f"{points:.3g} points, {size / 2**30:.2f} GiB, {args.fields}, load {os.getloadavg()[0]:.1f}")
        copies, divisions = [], []
        for _ in range(args.repeat):
            os.sync()
            marks = [processor_s()]
            copies.append(copy(cloud, work / "copy.pcd"))
            marks.append(processor_s())
            (work / "copy.pcd").unlink()
            os.sync()
            began = time.perf_counter()
            done = subprocess.run(
                [
                    sys.executable, "-m", "shmmap.cli", "divide", str(cloud), str(work / "map"),
                    "--max-memory", args.max_memory, "--quiet", "--json", *args.options,
                ],
                check=True, capture_output=True, text=True,
            )  # fmt: skip
            divisions.append(time.perf_counter() - began)
            marks.append(processor_s())
            report = json.loads(done.stdout)
            assert args.options or report["points"] == points, report
            shutil.rmtree(work / "map")
            print(
                f"  cp+fsync {copies[-1]:6.2f} s (processors {marks[1] - marks[0]:.2f} s)"
                f"   divide {divisions[-1]:6.2f} s (processors {marks[2] - marks[1]:.2f} s)"
                f"   {report['cells']} cells, peak {report['peak_memory_bytes'] / 2**20:.0f} MiB"
            )
        ratio = statistics.median(divisions) / statistics.median(copies)
        print(
            f"median: cp+fsync {statistics.median(copies):.2f} s, divide {statistics.median(divisions):.2f} s"
            f", ratio {ratio:.2f} (limit: 3), load {os.getloadavg()[0]:.1f}"
        )
    finally:
        shutil.rmtree(work)


if __name__ == "__main__":
    main()

# SPDX-License-Identifier: Apache-2.0
"""`read_cloud` of a binary PLY against the same rows as a binary PCD file, interleaved.

    python -m tests.benchmarks.load_ply [--points 2000000] [--repeats 9]

Limit: 1.3 times the time of the PCD file.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shmmap.formats.cloud import read_cloud
from shmmap.formats.pcd.writer import write_pcd
from shmmap.formats.ply_header import ply_header

LIMIT = 1.3


def write_both(folder: Path, points: int) -> tuple[Path, Path, Path]:
    """Write the same rows as PCD and as PLY of both byte orders; returns their paths."""
    rng = np.random.default_rng(1)
    columns: dict[str, NDArray[Any]] = {axis: rng.random(points, np.float32) * 100 for axis in "xyz"}
    columns["intensity"] = rng.random(points, np.float32)
    columns["ring"] = rng.integers(0, 128, points).astype(np.uint16)
    columns["time"] = rng.random(points)
    write_pcd(folder / "a.pcd", columns)
    head = ply_header([(name, values.dtype) for name, values in columns.items()], points)
    rows = np.empty(points, [(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        rows[name] = values
    (folder / "little.ply").write_bytes(head + rows.tobytes())
    big = rows.astype(rows.dtype.newbyteorder(">"))
    (folder / "big.ply").write_bytes(head.replace(b"little", b"big") + big.tobytes())
    return folder / "a.pcd", folder / "little.ply", folder / "big.ply"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--points", type=int, default=2_000_000)
    parser.add_argument("--repeats", type=int, default=9, help="interleaved rounds (default 9)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="load_ply.") as folder:
        paths = write_both(Path(folder), options.points)
        times: dict[str, list[float]] = {path.name: [] for path in paths}
        for turn in range(options.repeats + 1):
            for path in paths:
                started = time.perf_counter()
                cloud = read_cloud(path)
                if turn:  # the first round warms caches and allocators
                    times[path.name].append(time.perf_counter() - started)
                assert len(cloud.xyz) == options.points
                del cloud
    base = float(np.median(times["a.pcd"]))
    print(f"{options.points} points of 30 bytes: PCD {base * 1e3:.1f} ms")
    met = True
    for name in ("little.ply", "big.ply"):
        ratio = float(np.median(np.divide(times[name], times["a.pcd"])))
        met = met and ratio <= LIMIT
        print(f"  {name:10s} {np.median(times[name]) * 1e3:8.1f} ms, {ratio:.2f} of it, limit {LIMIT}")
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())

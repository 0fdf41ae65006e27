# SPDX-License-Identifier: Apache-2.0
"""Time and memory of the catalogue at 10^4, 10^5 and 10^6 cells, beside Autoware's linear search.

    python -m tests.benchmarks.catalogue [--cells 10000 100000 1000000] [--dir /dev/shm] [--queries 2000]

For each size it makes that many tiny PCD files with their metadata under DIR (a million take 10 s in
/dev/shm, minutes on a disk), and measures, in a process of its own:

first       open_map().load() without a cache: list and stat all files, read the YAML, join, index
sidecar     the same from the cached catalogue, in a new process
circle      a circle of 200 m (about 355 cells of 20 m), median
square      Autoware's area of the same radius (about 441), median
linear      the same square by Autoware's algorithm (C++, -O2; numpy where there is no g++), median
memory      resident memory that loading from the sidecar added
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from tests.benchmarks.make_many_cells import make_many_cells

RADIUS = 200.0


def resident_bytes() -> int:
    """Resident memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def measure(root: Path, cache: Path, queries: int) -> None:
    """Load the map and query it; prints one line of JSON."""
    from shmmap.geometry import AutowareSquare, Circle
    from shmmap.origin.map_directory import open_map

    before = resident_bytes()
    start = time.perf_counter()
    catalogue = open_map(root, cache_dir=cache).load()
    load_s = time.perf_counter() - start
    start = time.perf_counter()
    version = catalogue.map_version
    version_s = time.perf_counter() - start
    memory = resident_bytes() - before
    result: dict[str, float] = {"cells": len(catalogue), "load_s": load_s, "version_s": version_s}
    tables = [catalogue.names, catalogue.by_base, catalogue.stamps, catalogue.boxes]
    tables += [table for grid in catalogue.made_of_boxes.grids for table in (grid.keys, grid.cells)]
    result.update(memory=memory, tables=sum(table.nbytes for table in tables), version=version)
    reach = float(catalogue.boxes[:, 2].max())
    rng = np.random.default_rng(1)
    for kind, name in ((Circle, "circle"), (AutowareSquare, "square")):
        micros, found = [], 0
        for x, y in rng.uniform(0.2 * reach, 0.8 * reach, (queries, 2)).tolist():
            area = kind(x, y, RADIUS)
            start = time.perf_counter()
            hit, _ = catalogue.query(area)
            micros.append((time.perf_counter() - start) * 1e6)
            found += len(hit)
        result[f"{name}_us"] = statistics.median(micros)
        result[f"{name}_cells"] = found / queries
    if shutil.which("g++") is None:
        micros = []
        for x, y in rng.uniform(0.2 * reach, 0.8 * reach, (max(10, queries // 100), 2)).tolist():
            area = AutowareSquare(x, y, RADIUS)
            start = time.perf_counter()
            np.flatnonzero(area.overlaps(catalogue.boxes))
            micros.append((time.perf_counter() - start) * 1e6)
        result["linear_us"] = statistics.median(micros)
    print(json.dumps(result))


def run_measure(root: Path, cache: Path, queries: int) -> dict[str, float]:
    """`measure` in a fresh interpreter."""
    command = [sys.executable, "-m", "tests.benchmarks.catalogue"]
    command += ["--measure", str(root), str(cache), "--queries", str(queries)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE)
    result: dict[str, float] = json.loads(done.stdout)
    return result


def autoware_us(build: Path, side: int) -> tuple[float, float] | None:
    """Median time of Autoware's search in microseconds, and its process's memory in bytes."""
    program = build / "autoware_area_search"
    if not program.exists():
        compiler = shutil.which("g++")
        if compiler is None:
            return None
        source = Path(__file__).with_suffix("").with_name("autoware_area_search.cpp")
        subprocess.run([compiler, "-O2", "-std=c++17", "-o", str(program), str(source)], check=True)
    count = max(9, min(501, 20_000_000 // side**2))
    done = subprocess.run([program, str(side), str(RADIUS), str(count)], check=True, stdout=subprocess.PIPE)
    micros, _, resident_kb = done.stdout.split()
    return float(micros), float(resident_kb) * 1024


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cells", type=int, nargs="+", default=[10_000, 100_000, 1_000_000])
    parser.add_argument("--dir", type=Path, default=Path(tempfile.gettempdir()))
    parser.add_argument("--queries", type=int, default=2000)
    parser.add_argument("--measure", nargs=2, type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        root, cache = arguments.measure
        measure(root, cache, arguments.queries)
        return
    titles = (
        "cells|first s|sidecar s|circle us|(cells)|square us|(cells)|linear us|ratio|memory MB|std::map MB"
    )
    columns = titles.split("|")
    print("".join(f"{column:>13}" for column in columns))
    for cells in arguments.cells:
        side = round(cells**0.5)
        with tempfile.TemporaryDirectory(prefix="shmmap-catalogue-", dir=arguments.dir) as scratch:
            work = Path(scratch)
            make_many_cells(work / "map", side)
            first = run_measure(work / "map", work / "cache", arguments.queries)
            # a map that changed within the last milliseconds is not cached; this one has settled now
            if not list((work / "cache").glob("*.catalogue")):
                first = run_measure(work / "map", work / "cache", arguments.queries)
            again = run_measure(work / "map", work / "cache", arguments.queries)
            if again["version"] != first["version"]:
                raise SystemExit("the sidecar gives another catalogue")
            peer = autoware_us(work, side)
        linear = peer[0] if peer else again["linear_us"]
        row = (
            f"{int(again['cells'])}",
            f"{first['load_s']:.3f}",
            f"{again['load_s']:.3f}",
            f"{again['circle_us']:.1f}",
            f"{again['circle_cells']:.0f}",
            f"{again['square_us']:.1f}",
            f"{again['square_cells']:.0f}",
            f"{linear:.0f}",
            f"{linear / again['square_us']:.0f}x",
            f"{again['memory'] / 1e6:.0f}",
            f"{peer[1] / 1e6:.0f}" if peer else "-",
        )
        print("".join(f"{text:>13}" for text in row))


if __name__ == "__main__":
    main()

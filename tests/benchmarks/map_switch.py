# SPDX-License-Identifier: Apache-2.0
"""What a reload costs the serving loop: a map of many cells changes while many of them are in memory.

    python -m tests.benchmarks.map_switch [--cells N] [--segments N] [--against ../other] [--pairs 3]

The cache of a daemon serves such a map, with segments for cells all over it; their files are not
made, as no loader reads them.  Then another state of the map is served: a file changed, eight, all, or a cell
more.
Printed are, for layers of single cells and for a layer that reads the cells around, the processor time of the
step that serves it and of the longest step after it, milliseconds; and of all steps together, until no
segment is left to be checked.  With ``--against``, another checkout's version takes turns with this one, and
the last column is the median of the paired ratios of all steps together (this version to the other).
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Final

import numpy as np

LAYERS: Final = {"alone": ("points",), "around": ("points", "normals(radius=1.0)")}
SCENES: Final = ("one changed", "eight changed", "all changed", "one more")
CELL_M: Final = 20.0


def measure(cells: int, segments: int) -> dict[str, tuple[float, float, float]]:
    """Return milliseconds of the switch, of the longest step after it, and of all, by scene and layers."""
    from shmmap.daemon.records import Key, Resident
    from shmmap.origin.catalogue import Catalogue
    from tests.support.divided_map import make_map
    from tests.unit.daemon.inner_daemon import InnerDaemon

    side = round(cells**0.5)
    corners = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2) * CELL_M
    boxes = np.hstack((corners, corners + CELL_M))
    names = np.array([b"city_%08d.pcd" % number for number in range(len(boxes))])
    stamps = np.ones((len(boxes), 3), np.int64)

    def finish(one: InnerDaemon) -> list[float]:
        """Check all segments that have to be checked; return the milliseconds of each step."""
        took_ms = []
        while one.map_switch.next_s <= one.now_s():
            begin_s = time.thread_time()
            one.map_switch.run_step(one.now_s())
            took_ms.append((time.thread_time() - begin_s) * 1e3)
        return took_ms

    def state(before: Catalogue | None, kept: int, changed: int) -> Catalogue:
        files = stamps[-kept:].copy()
        files[len(files) // 2 : len(files) // 2 + changed, 1] = time.time_ns()
        few = before is not None and kept == len(before)
        catalogue = Catalogue(
            id_prefix="/map/",
            names=before.names if few and before else names[-kept:],
            boxes=before.boxes if few and before else boxes[-kept:],
            stamps=files,
            before=before,
        )
        _ = catalogue.map_version
        return catalogue

    found = {}
    with tempfile.TemporaryDirectory() as scratch:
        made = make_map(Path(scratch) / "map", columns=1, rows=1)
        for kind, layers in LAYERS.items():
            one = InnerDaemon(str(made.root), cache_dir=scratch, budget_bytes=64 << 20)
            cache, switch = one.cache, one.map_switch
            before = state(None, len(boxes) - 1, 0)
            switch.switch(before, before.changes_from(cache.catalogue))
            finish(one)
            chosen = np.random.default_rng(1).choice(len(before), segments // len(layers), replace=False)
            middle = len(before) // 2
            for index in {*chosen.tolist(), *range(middle, middle + 8)}:
                for layer in layers:
                    key, version = Key(before.id(index), layer), cache.layers.version(index, layer)
                    resident = Resident(
                        f"/s{index}{layer}", key, version, 8192, 1, before.box(index), 0.0, 1.0
                    )
                    cache.ledger.enter(resident)
                    cache._enter(resident, index)
            for scene in SCENES:
                changed = {"one changed": 1, "eight changed": 8, "all changed": len(boxes)}.get(scene, 0)
                after = state(before, len(boxes) - (scene != "one more"), changed)
                change = after.changes_from(before)
                begin_s = time.thread_time()
                switch.switch(after, change)
                served_ms = (time.thread_time() - begin_s) * 1e3
                steps_ms = finish(one)
                whole_ms = served_ms + sum(steps_ms)
                found[f"{scene}, {kind}"] = served_ms, max(steps_ms, default=0.0), whole_ms
                before = after
            one.close()
    return found


def measured_in(checkout: str, cells: int, segments: int) -> dict[str, tuple[float, float, float]]:
    """Measure in a process that imports another checkout."""
    environment = {**os.environ, "PYTHONPATH": checkout, "OPENBLAS_NUM_THREADS": "1"}
    words = [sys.executable, __file__, "--cells", str(cells), "--segments", str(segments), "--once"]
    said = subprocess.run(words, env=environment, cwd=checkout, check=True, stdout=subprocess.PIPE).stdout
    found: dict[str, tuple[float, float, float]] = json.loads(said.splitlines()[-1])
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cells", type=int, default=1_000_000)
    parser.add_argument("--segments", type=int, default=100_000)
    parser.add_argument("--against", help="another checkout")
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--once", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.once:
        print(json.dumps(measure(arguments.cells, arguments.segments)))
        return
    here = str(Path(__file__).parents[2])
    checkouts = [os.path.abspath(arguments.against), here] if arguments.against else [here]
    runs = [
        [measured_in(one, arguments.cells, arguments.segments) for one in checkouts]
        for _ in range(arguments.pairs)
    ]
    print(f"{'':24}" + f"{'serves it':>12}{'longest then':>14}{'all':>10}" * len(checkouts))
    for scene in runs[0][0]:
        columns = [f"{scene:24}"]
        for version in range(len(checkouts)):
            served, longest, whole = zip(*(run[version][scene] for run in runs), strict=True)
            columns.append(f"{max(served):12.2f}{max(longest):14.2f}{statistics.median(whole):10.1f}")
        if len(checkouts) > 1:
            ratio = statistics.median(run[1][scene][2] / run[0][scene][2] for run in runs)
            columns.append(f"{ratio:8.3f}")
        print("".join(columns))


if __name__ == "__main__":
    main()

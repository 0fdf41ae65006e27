# SPDX-License-Identifier: Apache-2.0
"""A vehicle on a link that carries little more than it needs, in simulated time: the daemon's own policies.

    python -m tests.benchmarks.slow_origin_link

20 Mbit/s, 50 ms, cells of 350 kB on a grid of 20 m, a circle of 60 m, 12 m/s: 12 of the 20 Mbit/s are
needed.  No byte passes for 10 s of each minute.  Square blocks of 600 m, 4.2 km; a query each half second,
those of the first minute left out.  ``places`` is as many objects under way as a loader has places for, 32;
``budget`` is `shmmap.daemon.loading.link`.  All cells fit in memory, without ``--memory-cells``.

Measured: with the route 100 % either way; without, places 79.0 %, 28.0 s, 480 MB, budget 92.9 %, 14.5 s,
386 MB; with the route 293 MB.  A scheduler that knows the link and its outages, and looks 12 s ahead,
has 95.3 %, 12.5 s, 358 MB on this drive.

Printed are the share of queries that lack nothing, the longest time in which each lacked something, and the
bytes that came.
"""

from __future__ import annotations

import argparse
import math
import sys
from typing import NamedTuple

import numpy as np

from shmmap.origin.catalogue import Catalogue
from tests.benchmarks.slow_origin_drives import Drive, dense_catalogue
from tests.benchmarks.slow_origin_model import Counts, Outages, ThinLink
from tests.benchmarks.slow_origin_run import Setting, simulate

SIDE_M, LENGTH_M, SPEED_MPS, RADIUS_M = 600.0, 4200.0, 12.0, 60.0
STEP_M = 6.0
MBIT_S, DELAY_S, CELL_BYTES = 20.0, 0.05, 350_000
FIRST_S = 60.0
PLACES = 32
MEMORY_CELLS = 4000
"""All cells of the drive, as the scheduler that knows everything never evicts any."""


class Outcome(NamedTuple):
    """What came of a drive: share of queries that lacked nothing, longest gap in seconds, bytes."""

    whole: float
    gap_s: float
    nbytes: float


def thin_drive() -> Drive:
    """Round a square block."""
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)] * 3, dtype=np.float64)[:10] * SIDE_M
    along = np.arange(0.0, LENGTH_M + 1.0)
    ends = np.arange(len(corners)) * SIDE_M
    places = np.column_stack([np.interp(along, ends, column) for column in corners.T])
    places += np.array([10.3, 10.9])
    return Drive("block", along / SPEED_MPS, places, places[::3])


def outcome_of(counts: Counts, link: ThinLink) -> Outcome:
    """Judge a drive."""
    lacking = [(query.asked_s, query.stall_s > 0.0) for query in counts.queries if query.asked_s >= FIRST_S]
    gap_s = longest_s = 0.0
    since_s = math.inf
    for asked_s, lacks in lacking:
        since_s = min(since_s, asked_s) if lacks else math.inf
        gap_s = asked_s - since_s + STEP_M / SPEED_MPS if lacks else 0.0
        longest_s = max(longest_s, gap_s)
    return Outcome(1.0 - sum(lacks for _, lacks in lacking) / len(lacking), longest_s, link.carried_bytes)


def drive_once(
    drive: Drive, catalogue: Catalogue, row: str, *, budget: bool, memory_cells: int = MEMORY_CELLS
) -> Outcome:
    """Drive."""
    link = ThinLink(MBIT_S, DELAY_S, CELL_BYTES, Outages(10.0, 60.0, 45.0))
    setting = Setting(
        row, radius_m=RADIUS_M, step_m=STEP_M, loaders=PLACES, memory_cells=memory_cells, budget=budget
    )
    return outcome_of(simulate(drive, catalogue, link, setting), link)


def main() -> int:
    """Drive with and without a route, and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--memory-cells", type=int, default=MEMORY_CELLS, help="cells that memory has room for"
    )
    options = parser.parse_args()
    drive = thin_drive()
    catalogue = dense_catalogue(drive)
    for row in ("none", "route", "no route"):
        for budget in (False, True):
            found = drive_once(drive, catalogue, row, budget=budget, memory_cells=options.memory_cells)
            print(
                f"{row:9} {'budget' if budget else 'places'}: lack nothing {100 * found.whole:6.2f} %,"
                f" longest gap {found.gap_s:5.1f} s, {found.nbytes / 1e6:6.1f} MB",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())

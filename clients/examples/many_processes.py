# SPDX-License-Identifier: Apache-2.0
"""Compute on the cells around a place in several processes, on one copy of the points.

    python3 many_processes.py X Y RADIUS              # metres, map frame

A pickled cell is a handle of some 300 bytes: each process attaches the same shared memory.  It is the same
with `concurrent.futures`, joblib, dask and Ray on one machine.
"""

from __future__ import annotations

import multiprocessing
import sys

import shmmap


def highest(cell: shmmap.Cell) -> tuple[str, float]:
    """Return a cell's name and its greatest z; runs in another process."""
    return cell.name, float(cell.xyz[:, 2].max()) + cell.origin[2]


def main() -> int:
    """Print the highest cell."""
    x, y, radius = map(float, sys.argv[1:4])
    with shmmap.connect() as client, multiprocessing.get_context("spawn").Pool(2) as pool:
        cells = client.around(x, y, radius, wait=60.0)  # keep them until the others have attached theirs
        name, z = max(pool.map(highest, [cell for cell in cells if len(cell)]), key=lambda found: found[1])
    print(f"{len(cells)} cells, the highest point is in {name}, at {z:.2f} m")
    return 0


if __name__ == "__main__":
    sys.exit(main())

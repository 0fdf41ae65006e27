# SPDX-License-Identifier: Apache-2.0
"""Makes a divided map of very many tiny cells, to try what only their number makes slow.

    python -m tests.benchmarks.make_many_cells OUT [--cells 1000000]

A square grid of 20 m cells from (0, 0).  The files are hard links to a few sound PCD files of one point
each, so a million of them need little space; the point lies in the first cell, whatever the file's name.
"""

from __future__ import annotations

import argparse
import itertools
import os
import struct
from pathlib import Path

CELL_METRES = 20

# ext4 allows 65 000 names for one file
_LINKS = 60_000

_PCD = """VERSION 0.7
FIELDS x y z intensity
SIZE 4 4 4 4
TYPE F F F F
COUNT 1 1 1 1
WIDTH {points}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {points}
DATA binary
"""


def make_many_cells(out: Path, side: int, points: int = 1, *, distinct: bool = False) -> None:
    """Write ``side`` x ``side`` cells of ``points`` points and their metadata into the new directory ``out``.

    With ``distinct`` each file has bytes of its own: its points lie in its middle.
    """
    cells = out / "pointcloud_map.pcd"
    cells.mkdir(parents=True)
    lines = [f"x_resolution: {CELL_METRES}\n", f"y_resolution: {CELL_METRES}\n"]
    fd = os.open(cells, os.O_RDONLY)
    try:
        first = ""
        span = range(0, side * CELL_METRES, CELL_METRES)
        for number, (x, y) in enumerate(itertools.product(span, span)):
            name = f"city_{x}_{y}.pcd"
            if distinct:
                middle = struct.pack("<4f", x + 0.5 * CELL_METRES, y + 0.5 * CELL_METRES, 0.0, number)
                (cells / name).write_bytes(_PCD.format(points=points).encode() + points * middle)
            elif number % _LINKS == 0:
                (cells / name).write_bytes(_PCD.format(points=points).encode() + bytes(16 * points))
                first = name
            else:
                os.link(first, name, src_dir_fd=fd, dst_dir_fd=fd)
            lines.append(f"{name}: [{x}, {y}]\n")
    finally:
        os.close(fd)
    (out / "pointcloud_map_metadata.yaml").write_text("".join(lines))


def main() -> None:
    """Make as many cells as asked, rounded to a square number."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--cells", type=int, default=1_000_000)
    arguments = parser.parse_args()
    make_many_cells(arguments.out, round(arguments.cells**0.5))


if __name__ == "__main__":
    main()

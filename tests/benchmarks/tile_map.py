# SPDX-License-Identifier: Apache-2.0
"""Tiles a PCD map into a larger divided map: copies side by side, whole cells apart.

    python -m tests.benchmarks.tile_map IN.pcd OUT [--copies 10] [--pitch 220] [--cell 20]

The real street map (59 cells of 20 m within 220 m x 220 m) tiled 10 x 10 makes 5 900 cells and 4.8 GB.
The shapes are real, the town is not: no drive leads through ten copies of the same street.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shmmap.dividing.map_writer import MapWriter, WrittenMap
from shmmap.formats.cloud import read_pcd

Columns = dict[str, NDArray[Any]]


def shifted(columns: Columns, shift: tuple[float, float], cell: float) -> Columns:
    """Copy of the points, moved, each still in the cell that its own cell became.

    float32 coarsens with distance: a point just below a border may round onto it, and is put back.
    """
    moved = dict(columns)
    xyz = columns["xyz"].copy()
    for axis, by in enumerate(shift):
        lower = np.floor(columns["xyz"][:, axis].astype(np.float64) / cell) * cell + by
        below = np.nextafter((lower + cell).astype(xyz.dtype), -np.inf, dtype=xyz.dtype)
        far = (columns["xyz"][:, axis].astype(np.float64) + by).astype(xyz.dtype)
        xyz[:, axis] = np.clip(far, lower.astype(xyz.dtype), below)
    moved["xyz"] = xyz
    return moved


def tile_map(
    source: Path, out: Path, *, copies: int = 10, pitch: float = 220.0, cell: float = 20.0
) -> WrittenMap:
    """Write ``copies`` x ``copies`` of the map in ``source``, ``pitch`` metres apart, as a divided map."""
    if pitch % cell:
        raise SystemExit(f"the pitch must be whole cells: {pitch} m is not, for cells of {cell} m")
    columns = dict(read_pcd(source).columns)
    # copies may interlock, but a cell that two of them fill is refused by the writer
    with MapWriter(out, cell_size=cell, prefix="tiled", durable=False) as writer:
        for row in range(copies):
            for column in range(copies):
                writer.add(shifted(columns, (pitch * column, pitch * row), cell))
        return writer.finish()


def main() -> None:
    """Tile as the arguments say."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("source", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--copies", type=int, default=10)
    parser.add_argument("--pitch", type=float, default=220.0)
    parser.add_argument("--cell", type=float, default=20.0)
    arguments = parser.parse_args()
    start = time.perf_counter()
    result = tile_map(
        arguments.source, arguments.out, copies=arguments.copies, pitch=arguments.pitch, cell=arguments.cell
    )
    seconds = time.perf_counter() - start
    print(f"{result.path}: {result.cells} cells, {result.points} points in {seconds:.1f} s")


if __name__ == "__main__":
    main()

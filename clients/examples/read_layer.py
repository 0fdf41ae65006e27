# SPDX-License-Identifier: Apache-2.0
"""Read a layer with its units: the mean of the points in each voxel of half a metre, around a place.

    python3 read_layer.py X Y RADIUS                  # metres, map frame

A layer is computed from a cell's points once per machine; every program reads the same bytes.
"""

from __future__ import annotations

import sys

import numpy as np

import shmmap


def main() -> int:
    """Request the layer and read its columns."""
    x, y, radius = map(float, sys.argv[1:4])
    with shmmap.connect() as client:
        # wait: the first request computes the layer, and compiles its kernel on a new machine
        cells = client.around(x, y, radius, layers="voxel(leaf=0.5)", wait=60.0)
        # Errors are values, one for each cell that cannot be loaded; the other cells are usable.
        for failure in cells.failed:
            print(failure, file=sys.stderr)
        for cell in cells:
            # Columns are numpy arrays over shared memory, read-only; add `origin` if it is not zero.
            means, counts = cell["xyz"], cell["count"]
            low, high = means.min(axis=0) + cell.origin, means.max(axis=0) + cell.origin
            print(
                f"{cell.id}: {len(means)} voxels of {counts.sum()} points, from {np.round(low, 2)}"
                f" to {np.round(high, 2)} m"
            )
            for name in cell.column_names:  # LAYERS.md says what each one is
                print(f"  {name}: {cell[name].dtype}, {cell[name].shape}, unit {cell.unit(name) or 'none'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

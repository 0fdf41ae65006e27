# SPDX-License-Identifier: Apache-2.0
"""Compute on the map's points with PyTorch, without a copy.

    python3 points_in_torch.py X Y RADIUS             # metres, map frame

`Cell.to_torch` returns tensors over the cell's shared memory.  They are writable: writing to a page makes a
private copy of it, which no other program sees.
"""

from __future__ import annotations

import sys

import torch

import shmmap


def main() -> int:
    """Print the mean of the points, and their spread along the principal axes."""
    x, y, radius = map(float, sys.argv[1:4])
    with shmmap.connect() as client:
        tensors = [cell.to_torch()["xyz"] for cell in client.around(x, y, radius, wait=60.0)]
    # Cells remain valid after the client is closed.  Sums are relative to the requested place, in doubles.
    place = torch.tensor([x, y, 0.0], dtype=torch.float64)
    points = torch.cat([xyz.double() - place for xyz in tensors])  # the only copy
    spread = torch.linalg.eigh(torch.cov(points.T)).eigenvalues.clamp(min=0.0).sqrt()
    print(f"{len(points)} points, their mean at {(points.mean(dim=0) + place).tolist()} m")
    print(f"standard deviations along their axes: {spread.tolist()} m")
    return 0


if __name__ == "__main__":
    sys.exit(main())

# SPDX-License-Identifier: Apache-2.0
"""Compute on the map's points with PyTorch, without a copy.

    python3 points_in_torch.py X Y RADIUS             # metres, map frame

`Cell.to_torch` gives tensors over the cell's shared memory.  They may be written: a page that is written
becomes this process's own, and no other program sees it.
"""

from __future__ import annotations

import sys

import torch

import shmmap


def main() -> int:
    """Find where the points are, and along which axes they spread."""
    x, y, radius = map(float, sys.argv[1:4])
    with shmmap.connect() as client:
        tensors = [cell.to_torch()["xyz"] for cell in client.around(x, y, radius, wait=60.0)]
    # Cells outlive the client.  Sums are about the place that was asked for, in double precision.
    place = torch.tensor([x, y, 0.0], dtype=torch.float64)
    points = torch.cat([xyz.double() - place for xyz in tensors])  # the only copy
    spread = torch.linalg.eigh(torch.cov(points.T)).eigenvalues.clamp(min=0.0).sqrt()
    print(f"{len(points)} points, their mean at {(points.mean(dim=0) + place).tolist()} m")
    print(f"standard deviations along their axes: {spread.tolist()} m")
    return 0


if __name__ == "__main__":
    sys.exit(main())

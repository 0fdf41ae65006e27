# SPDX-License-Identifier: Apache-2.0
"""Batches of points for PyTorch: a DataLoader whose workers read the map's shared memory.

    python3 torch_loader.py X Y RADIUS [fork|spawn]   # metres, map frame

Workers that are forked have the cells as they are; those that are spawned get handles and attach the same
memory.  In both ways the points of the map are in memory once.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import torch
from torch.utils.data import DataLoader

import shmmap


class CellSamples:  # what has a length and items is a dataset
    """Of each cell, 1024 points at random, relative to its corner: (1024, 3) float32, metres."""

    def __init__(self, cells: Sequence[shmmap.Cell]) -> None:
        self.cells = [cell for cell in cells if len(cell)]

    def __len__(self) -> int:
        return len(self.cells)

    def __getitem__(self, index: int) -> torch.Tensor:
        cell = self.cells[index]
        xyz = cell.to_torch()["xyz"]
        corner = torch.tensor([*cell.box[:2], 0.0], dtype=torch.float64)
        return (xyz[torch.randint(len(xyz), (1024,))].double() - corner).float()


def main() -> int:
    """Print the shapes of the batches."""
    x, y, radius = map(float, sys.argv[1:4])
    method = sys.argv[4] if len(sys.argv) > 4 else "spawn"
    with shmmap.connect() as client:
        samples = CellSamples(client.around(x, y, radius, wait=60.0))
    loader = DataLoader(samples, batch_size=4, num_workers=2, multiprocessing_context=method)
    for batch in loader:
        print(tuple(batch.shape), f"mean height {batch[..., 2].mean():.2f} m")
    return 0


if __name__ == "__main__":
    sys.exit(main())

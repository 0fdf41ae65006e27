# SPDX-License-Identifier: Apache-2.0
"""Cells as the objects of other libraries, over the same memory.

None of these libraries knows read-only memory.  What they return claims to be writeable, and writing
to it ends the process (SIGSEGV); nothing else can be harmed, the mapping itself is read-only.

DLPack: ``cell.xyz`` is exported read-only by numpy 2.1 and later to consumers that ask for DLPack 1.0
(``np.from_dlpack(cell.xyz)`` does); older consumers get a BufferError, never a copy.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import open3d
    import torch

    from shmmap.client.cell import Cell

__all__ = ["open3d_cloud", "torch_tensors"]


def open3d_cloud(cell: Cell) -> open3d.t.geometry.PointCloud:
    """Return ``open3d.t.geometry.PointCloud`` over a cell's memory; see `Cell.to_open3d`."""
    import open3d

    cloud = open3d.t.geometry.PointCloud()
    for name, view in cell.columns.items():
        # Open3D wants a row per point, also where a point has one value
        rows = view if view.ndim > 1 else view.reshape(-1, 1)
        cloud.point["positions" if name == "xyz" else name] = open3d.core.Tensor.from_numpy(rows)
    return cloud


def torch_tensors(cell: Cell) -> dict[str, torch.Tensor]:
    """Return a tensor for each column over a cell's memory; see `Cell.to_torch`."""
    import torch

    with warnings.catch_warnings():
        # that the array is not writeable: said in the documentation instead of once in a process
        warnings.filterwarnings("ignore", message=".*not writ[e]?able.*", category=UserWarning)
        return {name: torch.from_numpy(view) for name, view in cell.columns.items()}

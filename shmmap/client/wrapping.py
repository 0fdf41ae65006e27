# SPDX-License-Identifier: Apache-2.0
"""Cells as the objects of other libraries, over the same memory.

None of these libraries knows read-only memory; the memory they are given may be written
(`shmmap.segment.attach.attach_writable`).

DLPack: ``cell.xyz`` is exported read-only by numpy 2.1 and later to consumers that ask for DLPack 1.0
(``np.from_dlpack(cell.xyz)`` does); older consumers get a BufferError, never a copy.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from shmmap.optional_packages import needed_packages

if TYPE_CHECKING:
    import open3d
    import torch
    from numpy.typing import NDArray

__all__ = ["open3d_cloud", "torch_tensors"]


def open3d_cloud(columns: Mapping[str, NDArray[Any]]) -> open3d.t.geometry.PointCloud:
    """Return ``open3d.t.geometry.PointCloud`` over the memory of columns; see `Cell.to_open3d`."""
    with needed_packages("to_open3d()"):
        import open3d

    cloud = open3d.t.geometry.PointCloud()
    for name, view in columns.items():
        # Open3D wants a row per point, also where a point has one value
        rows = view if view.ndim > 1 else view.reshape(-1, 1)
        cloud.point["positions" if name == "xyz" else name] = open3d.core.Tensor.from_numpy(rows)
    return cloud


def torch_tensors(columns: Mapping[str, NDArray[Any]]) -> dict[str, torch.Tensor]:
    """Return a tensor for each column over that memory; see `Cell.to_torch`."""
    with needed_packages("to_torch()"):
        import torch

    return {name: torch.from_numpy(view) for name, view in columns.items()}

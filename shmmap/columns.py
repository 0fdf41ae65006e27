# SPDX-License-Identifier: Apache-2.0
"""What a table of points is made of: named columns, each with its dtype, width and unit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["ColumnSpec"]


@dataclass(frozen=True, slots=True)
class ColumnSpec:
    """One column: ``components`` values of ``dtype`` per row, in ``unit`` (SI, empty if unknown).

    One component means an array of shape (N,), more of shape (N, components).
    """

    name: str
    dtype: np.dtype[np.generic]
    components: int = 1
    unit: str = ""

    @property
    def row_bytes(self) -> int:
        """Bytes of one row."""
        return self.dtype.itemsize * self.components

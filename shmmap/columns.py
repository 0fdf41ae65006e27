# SPDX-License-Identifier: Apache-2.0
"""What a table of points is made of: named columns, each with its dtype, width and unit."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

__all__ = ["ColumnSpec", "column_names"]


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


def column_names(names: Iterable[str]) -> tuple[str, ...]:
    """Return names for columns beside ``xyz``: printable words, each once, and none that PCD reserves.

    White space and unprintable characters become underscores; a name that is in use gets a number.
    """
    taken = {"xyz", "x", "y", "z", "_"}  # a field called _ is padding
    found: list[str] = []
    for name in names:
        word = "".join(char if char.isprintable() and not char.isspace() else "_" for char in name)
        new, number = word or "_unnamed", 1
        while new in taken:
            number += 1
            new = f"{word}_{number}"
        taken.add(new)
        found.append(new)
    return tuple(found)

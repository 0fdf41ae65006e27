# SPDX-License-Identifier: Apache-2.0
"""PCD files as the points in millimetres that are published of them: layers are computed of those."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from shmmap.layers.contract import Box
from shmmap.layers.sources import CellSource, Files
from shmmap.origin.remote.millimetres import to_millimetres
from shmmap.segment.version import Source

__all__ = ["RoundedFiles"]

_XYZ: Final = "xyz"


class RoundedFiles(Files):
    """A `shmmap.layers.sources.SourceReader`: rows and coordinates as a reader of the map has them."""

    def read(self, source: Source, box: Box, needs: Sequence[str] | None) -> CellSource:
        """Read the file, its points rounded and in their new order."""
        found = super().read(source, box, None if needs is None else [_XYZ, *(n for n in needs if n != _XYZ)])
        table = found.points
        columns = {name: values for name, values in table.columns.items() if needs is None or name in needs}
        rounded = to_millimetres(table.columns[_XYZ])
        if rounded is None:
            return replace(found, points=replace(table, columns=columns))
        xyz = rounded.xyz
        ordered = {name: xyz if name == _XYZ else values[rounded.order] for name, values in columns.items()}
        low, high = float(xyz[:, 2].min()), float(xyz[:, 2].max())
        return replace(found, points=replace(table, columns=ordered), z_min=low, z_max=high)

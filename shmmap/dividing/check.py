# SPDX-License-Identifier: Apache-2.0
"""Reads a divided map back and proves it, by the project's own reader of maps."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from typing import Any

from shmmap.dividing.lattice import CellLattice
from shmmap.dividing.progress import Progress
from shmmap.errors import MapDataError
from shmmap.formats.pcd.reader import PcdReader

__all__ = ["check_cells"]


def check_cells(
    directory: str,
    counts: Mapping[tuple[int, int], int],
    name: Callable[[int, int], str],
    lattice: CellLattice,
    row: Any,
    progress: Progress,
) -> None:
    """Check that the files are those of ``counts``, have so many points, and all of them in their cell.

    Raises
    ------
    MapDataError
        Something is not as it was written: a defect of the disk, of the memory, or of shmmap.
    """
    progress.stage("checking", sum(counts.values()))
    wanted = {name(*where): where for where in counts}
    if set(os.listdir(directory)) != set(wanted):
        raise MapDataError("not the files that were written", path=directory, cause="check_failed")
    fields = set(row.names)
    for file, where in wanted.items():
        path = os.path.join(directory, file)
        with PcdReader(path) as reader:
            for block in reader.blocks():
                progress.advance(len(block[0]))
            (low_x, low_y, _), (high_x, high_y, _) = reader.bounds
            names = {field.name for field in reader.header.fields}
            points, kept = reader.header.points, reader.kept
        (x, y), (next_x, next_y) = lattice.corner(*where), lattice.corner(where[0] + 1, where[1] + 1)
        if not (points == kept == counts[where] and names == fields):
            raise MapDataError(
                f"{kept} of {points} points read, {counts[where]} were written",
                path=path,
                cause="check_failed",
            )
        if not (x <= low_x and high_x < next_x and y <= low_y and high_y < next_y):
            raise MapDataError("it has points outside its cell", path=path, cause="check_failed")

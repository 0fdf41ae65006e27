# SPDX-License-Identifier: Apache-2.0
"""Clouds for tests of dividing, and what the result must be, one point at a time."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from shmmap.dividing.divide import divide
from shmmap.dividing.settings import DivideSettings
from shmmap.formats.pcd.writer import write_pcd
from shmmap.origin.map_report import DividedMap
from tests.support.divided_map import read_pcd

Columns = dict[str, NDArray[Any]]
Row = tuple[Any, ...]


def xyzircaedt(count: int, *, seed: int = 0, reach: float = 90.0) -> Columns:
    """A cloud with the fields of Autoware's PointXYZIRCAEDT; some points lie exactly on corners."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-reach, reach, (3, count)).astype(np.float32)
    xyz[:2, ::7] = np.round(xyz[:2, ::7] / 20) * 20
    return {
        "x": xyz[0],
        "y": xyz[1],
        "z": xyz[2] / 10,
        "intensity": rng.integers(0, 256, count).astype(np.uint8),
        "return_type": rng.integers(0, 9, count).astype(np.uint8),
        "channel": rng.integers(0, 128, count).astype(np.uint16),
        "azimuth": rng.uniform(-3, 3, count).astype(np.float32),
        "elevation": rng.uniform(-1, 1, count).astype(np.float32),
        "distance": rng.uniform(0, 200, count).astype(np.float32),
        "time_stamp": np.arange(count, dtype=np.uint32),
    }


def cloud_file(path: Path, columns: Columns, encoding: str = "binary") -> Path:
    """Write a cloud as PCD; returns its path."""
    write_pcd(path, columns, encoding=encoding)
    return path


def divide_quickly(inputs: Sequence[Path], out: Path, **options: Any) -> DividedMap:
    """Divide without forcing anything to the disk."""
    return divide(inputs, out, DivideSettings(**{"durable": False, **options}))


def rows_of(columns: Mapping[str, NDArray[Any]]) -> list[Row]:
    """Rows of a cloud as tuples of Python numbers."""
    return list(zip(*(column.tolist() for column in columns.values()), strict=True))


def map_rows(
    out: Path, read: Callable[[Path], Mapping[str, NDArray[Any]]] = read_pcd
) -> dict[str, list[Row]]:
    """Rows of every file of a divided map by file name, read by ``read``; the metadata must name each."""
    files = sorted((out / "pointcloud_map.pcd").iterdir())
    found = {file.name: rows_of(read(file)) for file in files}
    corners = yaml.safe_load((out / "pointcloud_map_metadata.yaml").read_text())
    corners.pop("x_resolution"), corners.pop("y_resolution")
    assert sorted(corners) == sorted(found)
    return found


def expected_rows(rows: list[Row], size: str = "20", prefix: str = "") -> dict[str, list[Row]]:
    """The same, one point at a time, in fractions; rows start with x and y and keep their order."""
    step = Fraction(size)
    cells: dict[str, list[Row]] = {}
    for row in rows:
        corner = [math.floor(Fraction(value) / step) * step for value in row[:2]]
        text = "_".join(f"{float(c):.15g}" for c in corner)
        cells.setdefault(f"{prefix}_{text}.pcd", []).append(row)
    return dict(sorted(cells.items()))

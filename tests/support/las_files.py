# SPDX-License-Identifier: Apache-2.0
"""LAS and LAZ files made by laspy."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import laspy
import numpy as np
from numpy.typing import NDArray

POINTS = 1000


def write_las(
    path: Path,
    columns: dict[str, NDArray[Any]],
    *,
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0),
    point_format: int = 6,
) -> laspy.LasData:
    """Write x, y, z at a millimetre and intensity; other columns become extra dimensions."""
    header = laspy.LasHeader(point_format=point_format, version="1.4" if point_format >= 6 else "1.2")
    header.scales, header.offsets = np.full(3, 0.001), np.array(offset)
    extra = [name for name in columns if name not in ("x", "y", "z", "intensity")]
    header.add_extra_dims([laspy.ExtraBytesParams(name, columns[name].dtype) for name in extra])
    las = laspy.LasData(header)
    las.x, las.y, las.z = (columns[axis].astype(np.float64) for axis in "xyz")
    las.intensity = columns["intensity"].astype(np.uint16)
    for name in extra:
        las[name] = columns[name]
    las.write(str(path))
    return las


def las_file(path: Path, *, version: str = "1.4", form: int = 6, points: int = POINTS) -> Path:
    """Write points on a line, 0.1 m apart."""
    header = laspy.LasHeader(point_format=form, version=version)
    header.scales = np.full(3, 0.01)
    las = laspy.LasData(header)
    las.x = las.y = las.z = np.arange(points) * 0.1
    las.write(str(path))
    return path


def patched(path: Path, at: int, code: str, *values: float) -> Path:
    """Write values over a file's bytes."""
    data = bytearray(path.read_bytes())
    struct.pack_into("<" + code, data, at, *values)
    path.write_bytes(bytes(data))
    return path

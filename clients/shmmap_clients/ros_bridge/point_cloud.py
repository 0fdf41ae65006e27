# SPDX-License-Identifier: Apache-2.0
"""Cells of the map as ``sensor_msgs/PointCloud2``, byte for byte as Autoware's map loader sends them.

Autoware's map loader reads a file by ``pcl::io::loadPCDFile`` and sends all its fields: each with its own
type, without gaps, in the file's order. A map of x y z intensity has points of 16 bytes, one of x y z has
points of 12. A cell's columns are the same fields. Autoware's nodes look x, y and z up by name and take only
float32, so doubles, and coordinates relative to an origin, are rounded to float32 here.

Differences from Autoware: a cell has no points that are not finite; ``height`` is always 1; 64-bit integers,
for which the message has no type, are left out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap_clients.ros_bridge.cdr import CdrWriter

__all__ = ["CloudLayout", "cloud_layout", "fill_rows", "write_cloud", "write_cloud_head"]

_DATATYPES: Final = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
"""Numbers of ``sensor_msgs/PointField``, by numpy's type names."""
_FLOAT32: Final = 7


@dataclass(frozen=True, slots=True)
class CloudLayout:
    """Layout of a point's bytes.

    Attributes
    ----------
    fields
        Name, offset, type and count of each value.
    columns
        Name, offset, type and count of each of the cell's columns, of which ``xyz`` is three fields.
    point_step
        Size of a point, bytes.
    described
        The fields as bytes of the message, to be aligned to four.
    """

    fields: tuple[tuple[str, int, int, int], ...]
    columns: tuple[tuple[str, int, np.dtype[Any], int], ...]
    point_step: int
    described: bytes


def cloud_layout(columns: Mapping[str, NDArray[Any]]) -> CloudLayout:
    """Return the layout for columns of these names and types, (N,) or (N, k)."""
    return _layout(
        tuple((name, one.dtype.str[1:], math.prod(one.shape[1:])) for name, one in columns.items())
    )


@lru_cache(maxsize=64)
def _layout(kinds: tuple[tuple[str, str, int], ...]) -> CloudLayout:
    """Return the layout for columns by name, numpy's name of the type, and number of values."""
    fields: list[tuple[str, int, int, int]] = []
    places: list[tuple[str, int, np.dtype[Any], int]] = []
    offset = 0
    for name, kind, count in kinds:
        if name == "xyz":
            fields += [(axis, offset + 4 * n, _FLOAT32, 1) for n, axis in enumerate("xyz")]
            kind = "f4"
        elif kind in _DATATYPES:
            fields.append((name, offset, _DATATYPES[kind], count))
        else:
            continue
        places.append((name, offset, np.dtype(f"<{kind}"), count))
        offset += int(kind[1:]) * count
    writer = CdrWriter()
    writer.numbers("I", len(fields))
    for name, start, datatype, count in fields:
        writer.text(name)
        writer.numbers("IB", start, datatype)
        writer.numbers("I", count)
    writer.numbers("?", False)  # is_bigendian
    writer.numbers("I", offset)
    return CloudLayout(tuple(fields), tuple(places), offset, bytes(writer.content()[4:]))


def write_cloud(
    writer: CdrWriter,
    columns: Mapping[str, NDArray[Any]],
    origin: tuple[float, float, float],
    frame_id: str = "",
    stamp_ns: int = 0,
) -> None:
    """Append a ``PointCloud2``; inside a cell, its header is empty, as in Autoware.

    Parameters
    ----------
    columns
        Columns of equal lengths; they are read when the message is assembled.
    origin
        Origin of ``xyz``, metres.
    frame_id, stamp_ns
        Frame and time of the header, nanoseconds since 1970.
    """
    layout, points = cloud_layout(columns), len(columns["xyz"])
    nbytes = points * layout.point_step
    write_cloud_head(writer, layout, points, frame_id, stamp_ns)
    writer.numbers("I", nbytes)
    if nbytes:
        writer.blob(nbytes, partial(fill_rows, columns=columns, origin=origin, layout=layout))
    writer.numbers("?", True)  # is_dense: every coordinate is finite


def write_cloud_head(
    writer: CdrWriter, layout: CloudLayout, points: int, frame_id: str = "", stamp_ns: int = 0
) -> None:
    """Append the part before the points: header, size, fields."""
    writer.numbers("iI", stamp_ns // 10**9, stamp_ns % 10**9)
    writer.text(frame_id)
    writer.numbers("II", 1, points)  # height, width
    writer.prepared(layout.described)
    writer.numbers("I", layout.point_step * points)


def fill_rows(
    place: memoryview,
    columns: Mapping[str, NDArray[Any]],
    origin: tuple[float, float, float],
    layout: CloudLayout,
) -> None:
    """Write points into ``place``; each value is copied once, from shared memory to the sample.

    Copying field by field is five times as fast as point by point.  A column that is missing, or differs from
    the layout, leaves zeros.
    """
    step = layout.point_step
    count = len(place) // step
    for name, offset, kind, values_each in layout.columns:
        column = columns.get(name)
        if column is None or column.shape[0] != count or math.prod(column.shape[1:]) != values_each:
            continue
        values = column.reshape(count, values_each)
        for n in range(values_each):
            target: NDArray[Any] = np.ndarray((count,), kind, place, offset + n * kind.itemsize, (step,))
            if name == "xyz" and origin[n]:
                np.add(values[:, n], origin[n], out=target, dtype=np.float64, casting="same_kind")
            else:
                target[...] = values[:, n]

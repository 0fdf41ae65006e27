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
from array import array
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest, CellInfo, Client, LoadFailed

MAX_BYTES: Final = 2**31 - 1
"""Largest message, 2.147 GB: CycloneDDS sends no larger sample, and lengths in messages have 32 bits."""

_DATATYPES: Final = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
"""Numbers of ``sensor_msgs/PointField``, by numpy's type names."""
_FLOAT32: Final = 7
_CELL_BYTES: Final = 256
_HEAD_BYTES: Final = 4096


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
    """

    fields: tuple[tuple[str, int, int, int], ...]
    columns: tuple[tuple[str, int, np.dtype[Any], int], ...]
    point_step: int


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
    return CloudLayout(tuple(fields), tuple(places), offset)


def message_bytes(columns: Mapping[str, NDArray[Any]], name: str) -> int:
    """Return a bound of what a cell of these columns and this name takes in a message."""
    layout = cloud_layout(columns)
    described = sum(4 * len(field) + 24 for field, *_ in layout.fields)
    return len(columns["xyz"]) * layout.point_step + described + 4 * len(name) + _CELL_BYTES


def fill_rows(
    place: memoryview,
    columns: Mapping[str, NDArray[Any]],
    origin: tuple[float, float, float],
    layout: CloudLayout,
) -> None:
    """Write points into ``place``; each value is copied once, from shared memory to the message.

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


def joined_cells(
    client: Client,
    cells: Collection[CellInfo],
    layer: str = "points",
    *,
    max_bytes: int = MAX_BYTES,
    wait_s: float,
) -> tuple[CloudLayout, int, array[int]]:
    """Return all points of a map as one cloud: layout, number of points, and their bytes.

    Each cell is released before the next one is requested, so the daemon's budget need not hold the map.

    The fields are those of the first cell with points. Additional fields of other cells are left out, and
    fields that a cell lacks are zero. Autoware instead joins the bytes of all cells, whatever their fields.

    Parameters
    ----------
    client
        Client of the daemon.
    cells
        All cells of the map, in the order of their points in the cloud.
    layer
        Layer to take of each cell; it has ``xyz``.
    max_bytes
        Largest message.
    wait_s
        Time for a cell to load, seconds.

    Raises
    ------
    BadRequest
        The map has more bytes than that; the error names its approximate size.
    LoadFailed
        A cell cannot be loaded, so that the map would have a hole.
    """
    layout: CloudLayout | None = None
    points, read_bytes, data = 0, 0, array("B")
    for info in cells:
        found = client.selected([info.id], layer, wait=wait_s, strict=None).raise_for_failures()
        if not found.complete or not found:
            raise LoadFailed(f"{info.id}: not loaded after {wait_s:g} s", cell_id=info.id, layer=layer)
        read_bytes += info.source_bytes
        cell = found[0]
        if not cell.points:
            continue
        layout = layout or cloud_layout(cell.columns)
        nbytes, place = cell.points * layout.point_step, len(data)
        if place + nbytes > min(max_bytes, MAX_BYTES) - _HEAD_BYTES:
            whole_bytes = (place + nbytes) / max(read_bytes, 1) * sum(one.source_bytes for one in cells)
            raise BadRequest(
                f"the whole map takes about {whole_bytes / 1e9:.3g} GB as a PointCloud2, and"
                f" {max_bytes / 1e9:.3g} GB is the most",
                hint="do not publish it whole: clients get the cells that they need from the services",
            )
        data.frombytes(bytes(nbytes))
        with memoryview(data) as whole, whole[place:] as rows:
            fill_rows(rows, cell.columns, cell.origin, layout)
        points += cell.points
    return layout or cloud_layout({}), points, data

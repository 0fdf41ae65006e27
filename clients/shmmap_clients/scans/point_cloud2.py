# SPDX-License-Identifier: Apache-2.0
"""Points of a ``sensor_msgs/msg/PointCloud2``: any fields, padding and byte order."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap import MapDataError
from shmmap_clients.scans.frames import seconds_of
from shmmap_clients.scans.scan_file import ScanReader
from shmmap_clients.scans.scan_sequence import Scan

_TYPES: Final = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""Types of fields by their numbers in ``sensor_msgs/msg/PointField``."""
_PADDING: Final = ("", "_")


def columns_of(cloud: Any, where: str) -> dict[str, NDArray[Any]]:
    """Return the columns of a cloud, rows of an organised one after each other.

    Parameters
    ----------
    cloud
        The message, its ``data`` as an array of bytes.
    where
        Place of the message, for errors.

    Returns
    -------
    ``xyz`` (N, 3), float64 if one of x, y, z is, else float32; and the other fields by name, (N,) or
    (N, count), in this machine's byte order.

    Raises
    ------
    MapDataError
        The fields, sizes and data contradict each other, or x, y or z is missing or no float.
    """
    width, height, step = int(cloud.width), int(cloud.height), int(cloud.point_step)
    if not width * height:
        return {"xyz": np.empty((0, 3), np.float32)}
    row_type = _row_type(cloud, step, where)
    line = width * step
    row_step = int(cloud.row_step) if height > 1 else line
    least = row_step * (height - 1) + line
    if row_step < line or not least <= len(cloud.data) <= max(least, int(cloud.row_step) * height):
        raise MapDataError(
            f"{where}: {len(cloud.data)} bytes are no {height} rows of {cloud.row_step} bytes with {width}"
            f" points of {step} bytes"
        )
    rows: NDArray[Any] = np.ndarray((height, width), row_type, cloud.data, 0, (row_step, step)).reshape(-1)
    columns = {name: rows[name].astype(rows[name].dtype.newbyteorder("=")) for name in row_type.names or ()}
    xyz = np.stack([columns.pop(axis) for axis in "xyz"], axis=1)
    return {"xyz": xyz, **columns}


def scan_of(cloud: Any, where: str, reader: ScanReader, T: NDArray[np.float64] | None = None) -> Scan:
    """Return the scan of a message, without its pose; its name is the message's time.

    Parameters
    ----------
    cloud, where
        As of `columns_of`.
    reader
        Filter of points, by their range in the message's frame.
    T : (4, 4), optional
        Transform of what is left to another frame.

    Raises
    ------
    MapDataError
        As `columns_of`.
    """
    columns, rows = reader.screened(columns_of(cloud, where))
    if T is not None and not np.array_equal(T, np.eye(4)):
        xyz = columns["xyz"]
        columns = {**columns, "xyz": (xyz @ T[:3, :3].T + T[:3, 3]).astype(xyz.dtype)}
    stamp = cloud.header.stamp
    return Scan(f"{stamp.sec}.{stamp.nanosec:09}", seconds_of(stamp), columns, rows=rows)


def _row_type(cloud: Any, step: int, where: str) -> np.dtype[Any]:
    """Return the type of a point."""
    order = ">" if cloud.is_bigendian else "<"
    fields: dict[str, tuple[str, tuple[int, ...], int]] = {}
    for field in cloud.fields:
        kind, count, offset = _TYPES.get(int(field.datatype)), max(int(field.count), 1), int(field.offset)
        if kind is None:
            raise MapDataError(f"{where}: field {field.name!r} has the unknown type {field.datatype}")
        if offset + count * int(kind[1]) > step:
            raise MapDataError(f"{where}: field {field.name!r} ends after a point's {step} bytes")
        if field.name in fields or field.name == "xyz":
            raise MapDataError(f"{where}: two fields are called {field.name!r}")
        if field.name not in _PADDING:
            fields[field.name] = order + kind, (count,) if count > 1 else (), offset
    for axis in "xyz":
        kind, shape, _ = fields.get(axis, ("", (), 0))
        if kind[1:] not in ("f4", "f8") or shape:
            found = f"is {kind[1:]}" if kind else "is missing"
            raise MapDataError(f"{where}: field {axis} {found}: points are float32 or float64 x, y, z")
    formats = [(kind, shape) if shape else kind for kind, shape, _ in fields.values()]
    offsets = [offset for *_, offset in fields.values()]
    return np.dtype({"names": [*fields], "formats": formats, "offsets": offsets, "itemsize": step})

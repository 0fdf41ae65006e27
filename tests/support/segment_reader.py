# SPDX-License-Identifier: Apache-2.0
"""A segment reader written from ``shmmap/segment/LAYOUT.md`` alone."""

from __future__ import annotations

import fcntl
import mmap
import os
import struct
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import shmmap
from shmmap.errors import LoadFailed
from tests.support.daemon_process import Deadline
from tests.support.divided_map import DividedMap
from tests.support.raw_client import RawClient, RawHandle


@dataclass
class SegmentBytes:
    """Everything a segment says, and its columns as copies or views of ``data``."""

    fields: dict[str, Any]
    columns: dict[str, NDArray[Any]]
    units: dict[str, str]
    checksums: dict[str, int]
    epoch: int | None
    version: int | None


def parse(data: bytes | mmap.mmap) -> SegmentBytes:
    """Read a segment; AssertionError where it contradicts the document."""
    assert data[0:8] == b"SHMMAP\x00\x01"
    major, _minor, order = struct.unpack_from("<HHI", data, 8)
    assert (major, order) == (1, 0x01020304)
    header_bytes, total_bytes, rows, source_points, dropped = struct.unpack_from("<QQQQQ", data, 16)
    size, mtime_ns, ctime_ns = struct.unpack_from("<Qqq", data, 56)
    digest = bytes(data[80:96])
    min_x, min_y, max_x, max_y, z_min, z_max, ox, oy, oz = struct.unpack_from("<9d", data, 96)
    builder, count, table, row_bytes = struct.unpack_from("<IIII", data, 168)
    texts = []
    for at in (184, 192, 200):
        where, length = struct.unpack_from("<II", data, at)
        texts.append(bytes(data[where : where + length]).decode())
    crc_at = header_bytes - 72
    assert struct.unpack_from("<I", data, crc_at)[0] == zlib.crc32(data[0:crc_at])
    columns: dict[str, NDArray[Any]] = {}
    units: dict[str, str] = {}
    checksums: dict[str, int] = {}
    for index in range(count):
        at = table + index * row_bytes
        name = bytes(data[at : at + 40]).rstrip(b"\0").decode()
        dtype = bytes(data[at + 40 : at + 48]).rstrip(b"\0").decode()
        units[name] = bytes(data[at + 48 : at + 64]).rstrip(b"\0").decode()
        (dimensions,) = struct.unpack_from("<I", data, at + 64)
        shape = struct.unpack_from("<4Q", data, at + 72)[:dimensions]
        offset, nbytes, checksums[name] = struct.unpack_from("<QQQ", data, at + 104)
        assert offset % 64 == 0
        assert header_bytes <= offset
        assert offset + nbytes <= total_bytes
        columns[name] = np.frombuffer(data, dtype, nbytes // np.dtype(dtype).itemsize, offset).reshape(shape)
    publish = header_bytes - 64
    epoch = version = None
    if bytes(data[publish : publish + 8]) != bytes(8):
        assert bytes(data[publish : publish + 8]) == b"PUBLISH\0"
        assert struct.unpack_from("<I", data, publish + 56)[0] == zlib.crc32(data[publish : publish + 56])
        epoch, version = struct.unpack_from("<QQ", data, publish + 8)
    fields = {
        "header_bytes": header_bytes,
        "total_bytes": total_bytes,
        "rows": rows,
        "source_points": source_points,
        "dropped_points": dropped,
        "source": (size, mtime_ns, ctime_ns),
        "digest": digest,
        "box": (min_x, min_y, max_x, max_y),
        "z": (z_min, z_max),
        "origin": (ox, oy, oz),
        "builder_version": builder,
        "cell_id": texts[0],
        "layer": texts[1],
        "frame_id": texts[2],
    }
    return SegmentBytes(fields, columns, units, checksums, epoch, version)


def map_segment(path: str | Path, session: int | None = None) -> mmap.mmap:
    """Map a segment as any other program would: plain open and mmap.

    With a session, take its lock as the document says; it lasts as long as the mapping.
    """
    fd = os.open(path, os.O_RDONLY)
    try:
        if session is not None:
            set_lock = 37  # F_OFD_SETLK; struct flock: type, whence, start, length, pid
            fcntl.fcntl(fd, set_lock, struct.pack("@hhqqi4x", fcntl.F_RDLCK, 0, session, 1, 0))
        return mmap.mmap(fd, 0, prot=mmap.PROT_READ)
    finally:
        os.close(fd)


def read_segment(path: str | Path) -> SegmentBytes:
    """Read a copy of a segment: nothing stays open or mapped."""
    return parse(Path(path).read_bytes())


# Whether what the daemon handed out is what the map's files hold


def names(cells: Iterable[Any]) -> list[str]:
    """File names of cells, or of handles."""
    return [cell.id.rsplit("/", 1)[-1] for cell in cells]


def assert_same_points(client: RawClient, handle: RawHandle, made: DividedMap) -> None:
    """The segment holds exactly what an independent reader finds in the file."""
    name = handle.id.rsplit("/", 1)[1]
    segment = read_segment(client.path(handle))
    source = made.points(name)
    expected = np.column_stack([source["x"], source["y"], source["z"]])
    assert segment.columns["xyz"].tobytes() == expected.tobytes()
    assert segment.columns["intensity"].tobytes() == source["intensity"].tobytes()
    assert segment.fields["cell_id"] == made.id(name) == handle.id
    assert segment.fields["box"] == made.box(name) == handle.box
    assert (segment.epoch, segment.version) == (client.epoch, handle.version)
    assert handle.points == segment.fields["rows"] == len(expected)
    assert segment.fields["dropped_points"] == 0


def assert_right(cells: shmmap.CellSet, made: DividedMap, wanted: list[str]) -> None:
    """All of them are there, each with exactly its file's bytes."""
    assert sorted(cell.id.rsplit("/", 1)[1] for cell in cells) == wanted
    for cell in cells:
        expected = made.points(cell.id.rsplit("/", 1)[1])
        assert cell.xyz[:, 0].tobytes() == expected["x"].tobytes()
        assert cell["intensity"].tobytes() == expected["intensity"].tobytes()


def whole(client: shmmap.Client, x: float, y: float, radius: float) -> shmmap.CellSet:
    """Ask until every cell is there: one that a loader died of is retried."""
    found = client.around(x, y, radius, wait=30.0)
    waiting = Deadline()
    while waiting(not found.complete):
        assert all(isinstance(failure, LoadFailed) for failure in found.failed), found
        found = client.around(x, y, radius, wait=30.0)
    return found

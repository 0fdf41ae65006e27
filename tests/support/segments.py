# SPDX-License-Identifier: Apache-2.0
"""Segments as the daemon makes them, of any columns, and damage of the kinds a killed daemon leaves."""

from __future__ import annotations

import os
import struct
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shmmap.columns import ColumnSpec
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.header import PublishBlock
from shmmap.segment.layout import SegmentHeader, SourceStamp
from shmmap.segment.names import new_segment_name
from shmmap.segment.writer import SegmentWriter

Box = tuple[float, float, float, float]


def write_segment(
    fd: int,
    columns: dict[str, NDArray[Any]],
    *,
    cell_id: str = "/map/a.pcd",
    layer: str = "points",
    box: Box = (0.0, 0.0, 20.0, 20.0),
    **source_facts: Any,
) -> SegmentHeader:
    """Write a segment into an empty file; ``source_facts`` replace what its header says of the source."""
    rows = len(next(iter(columns.values())))
    specs = [
        ColumnSpec(name, values.dtype, 1 if values.ndim == 1 else values.shape[1], "m" * (name == "xyz"))
        for name, values in columns.items()
    ]
    writer = SegmentWriter(specs, rows, cell_id=cell_id, layer=layer, box=box)
    writer.start(fd)
    for index, values in enumerate(columns.values()):
        writer.append(index, np.ascontiguousarray(values))
    facts: dict[str, Any] = {
        "z_min": 0.0,
        "z_max": 1.0,
        "source": SourceStamp(1, 2, 3),
        "source_digest": bytes(16),
        "source_points": rows,
        "dropped_points": 0,
        "builder_version": 1,
    }
    return writer.finish(**{**facts, **source_facts})


def publish_segment(
    directory: ShmDirectory,
    columns: dict[str, NDArray[Any]],
    *,
    block: PublishBlock,
    mode: int = 0o400,
    instance: str = "unit",
    **described: Any,
) -> tuple[str, SegmentHeader]:
    """Publish a segment; ``described`` as in `write_segment`.  Returns its name and header."""
    name = new_segment_name(instance)
    fd = directory.create()
    try:
        header = write_segment(fd, columns, **described)
        directory.publish(fd, name, block=block, header_bytes=header.header_bytes, mode=mode, gid=-1)
    finally:
        os.close(fd)
    return name, header


# Ways to spoil a segment that a killed daemon left


def _poke(path: str, at: int) -> None:
    os.chmod(path, 0o600)
    with open(path, "r+b") as file:
        file.seek(at)
        byte = file.read(1)
        file.seek(at)
        file.write(bytes([byte[0] ^ 0x10]))
    os.chmod(path, 0o400)


def damage_payload(path: str) -> None:
    _poke(path, 4096 + 64 * 3 + 1)


def damage_header(path: str) -> None:
    _poke(path, 96)


def other_layout(path: str) -> None:
    """Another major layout version, checksum and all."""
    _pack("<H", path, 8, 2)


def other_builder(path: str) -> None:
    """The layer as another version of its code makes it."""
    _pack("<I", path, 168, 200)


def _pack(code: str, path: str, at: int, value: int) -> None:
    """Change a field of a header, and give it a right checksum."""
    os.chmod(path, 0o600)
    with open(path, "r+b") as file:
        page = bytearray(file.read(4096))
        struct.pack_into(code, page, at, value)
        end = 4096 - 72
        struct.pack_into("<I", page, end, zlib.crc32(page[:end]))
        file.seek(0)
        file.write(page)
    os.chmod(path, 0o400)


def damage_publish_block(path: str) -> None:
    _poke(path, 4096 - 64 + 17)


def shorten(path: str) -> None:
    os.chmod(path, 0o600)
    os.truncate(path, 4096)
    os.chmod(path, 0o400)


def punch(path: str) -> None:
    os.chmod(path, 0o600)
    with open(path, "r+b") as file:
        file.seek(4096)
        file.write(bytes(4096))
    os.chmod(path, 0o400)

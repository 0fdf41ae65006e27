# SPDX-License-Identifier: Apache-2.0
"""Makes segments as the daemon does, of any columns."""

from __future__ import annotations

import os
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
    **told: Any,
) -> SegmentHeader:
    """Write a segment into an empty file; ``told`` replaces what its header says of the source."""
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
    return writer.finish(**{**facts, **told})


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

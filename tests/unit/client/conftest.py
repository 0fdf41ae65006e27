# SPDX-License-Identifier: Apache-2.0
"""Real segments in a private directory of shared memory, without a daemon."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from shmmap.client.attaching import Attacher
from shmmap.client.cell import Access, Cell
from shmmap.layers import LayerTable
from shmmap.protocol.messages import Handle
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.header import PublishBlock
from shmmap.segment.layout import SourceStamp
from shmmap.segment.names import new_segment_name
from shmmap.segment.writer import SegmentOrigin, write_table
from tests.support.segments import Box, publish_segment


class Segments:
    """Publishes segments and attaches them, as daemon and client do."""

    def __init__(self, path: str) -> None:
        self.path = path
        self.directory = ShmDirectory(path)
        self.attacher = Attacher()

    def publish(
        self,
        cell_id: str,
        columns: dict[str, NDArray[Any]],
        *,
        version: int = 1,
        box: Box = (0.0, 0.0, 20.0, 20.0),
        layer: str = "points",
        origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> tuple[str, Handle]:
        rows = len(next(iter(columns.values())))
        name, header = publish_segment(
            self.directory,
            columns,
            block=PublishBlock(epoch=7, version=version),
            cell_id=cell_id,
            box=box,
            layer=layer,
            origin=origin,
            z_min=-1.0,
            z_max=8.0,
            source=SourceStamp(11, 22, 33),
            source_digest=bytes(range(16)),
            source_points=rows + 2,
            dropped_points=2,
        )
        return name, Handle(cell_id, version, layer, name, 0, header.total_bytes, rows, *box)

    def attach(self, name: str, handle: Handle) -> Cell:
        access = Access(self.path, 99, None)
        return self.attacher.attached(handle) or self.attacher.attach(handle, handle.id, name, access)

    def cell(self, cell_id: str, columns: dict[str, NDArray[Any]], **options: Any) -> Cell:
        return self.attach(*self.publish(cell_id, columns, **options))

    def layer(self, spec: str, table: LayerTable) -> Cell:
        """Return a cell of a computed layer."""
        box, name, fd = (0.0, 0.0, 20.0, 20.0), new_segment_name("unit"), self.directory.create()
        try:
            header = write_table(
                fd,
                table.columns,
                layer=spec,
                rows=table.rows,
                origin=SegmentOrigin("/map/a.pcd", box, "map", SourceStamp(1, 2, 3), bytes(16), 0, 0),
                builder_version=1,
                units=table.units,
                lattice=table.lattice,
                z_min=0.0,
                z_max=1.0,
            )
            block = PublishBlock(epoch=7, version=1)
            self.directory.publish(
                fd, name, block=block, header_bytes=header.header_bytes, mode=0o400, gid=-1
            )
        finally:
            os.close(fd)
        return self.attach(name, Handle("/map/a.pcd", 1, spec, name, 0, header.total_bytes, table.rows, *box))


@pytest.fixture
def segments() -> Iterator[Segments]:
    path = tempfile.mkdtemp(prefix="shmmap-unit-", dir="/dev/shm")
    made = Segments(path)
    yield made
    made.directory.close()
    shutil.rmtree(path)


@pytest.fixture
def make_cell(segments: Segments) -> Callable[..., Cell]:
    """Make a cell of random points inside its box: ``make_cell(id, box, count=..., version=...)``."""

    def make(cell_id: str, box: Box, *, count: int = 200, version: int = 0, **options: Any) -> Cell:
        rng = np.random.default_rng(abs(hash((cell_id, version))) % 2**32)
        low, high = np.array([*box[:2], -1.0]), np.array([*box[2:], 8.0])
        xyz = (low + rng.random((count, 3)) * (high - low)).astype(np.float32)
        intensity = rng.random(count).astype(np.float32)
        return segments.cell(
            cell_id,
            {"xyz": xyz, "intensity": intensity},
            box=box,
            version=version or abs(hash(cell_id)) % 2**60,
            **options,
        )

    return make

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
from shmmap.client.cell import Cell
from shmmap.columns import ColumnSpec
from shmmap.protocol.messages import Handle
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.layout import PublishBlock, SourceStamp
from shmmap.segment.names import new_segment_name
from shmmap.segment.writer import SegmentWriter

Box = tuple[float, float, float, float]


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
        specs = [
            ColumnSpec(
                name, values.dtype, 1 if values.ndim == 1 else values.shape[1], "m" if name == "xyz" else ""
            )
            for name, values in columns.items()
        ]
        writer = SegmentWriter(specs, rows, cell_id=cell_id, layer=layer, box=box)
        fd = self.directory.create()
        try:
            writer.start(fd)
            for index, values in enumerate(columns.values()):
                writer.append(index, np.ascontiguousarray(values))
            header = writer.finish(
                z_min=-1.0,
                z_max=8.0,
                source=SourceStamp(11, 22, 33),
                source_digest=bytes(range(16)),
                source_points=rows + 2,
                dropped_points=2,
                builder_version=1,
                origin=origin,
            )
            name = new_segment_name("unit")
            block = PublishBlock(epoch=7, version=version)
            self.directory.publish(
                fd, name, block=block, header_bytes=header.header_bytes, mode=0o400, gid=-1
            )
        finally:
            os.close(fd)
        handle = Handle(cell_id, version, layer, name, 0, header.total_bytes, rows, *box)
        return name, handle

    def attach(self, name: str, handle: Handle) -> Cell:
        return self.attacher.attach(handle, handle.id, name, shm_dir=self.path, slot=99, populate=False)

    def cell(self, cell_id: str, columns: dict[str, NDArray[Any]], **options: Any) -> Cell:
        return self.attach(*self.publish(cell_id, columns, **options))


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
            cell_id, {"xyz": xyz, "intensity": intensity}, box=box,
            version=version or abs(hash(cell_id)) % 2**60, **options,
        )  # fmt: skip

    return make

# SPDX-License-Identifier: Apache-2.0
"""Segments to try things on."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from shmmap.columns import ColumnSpec
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.layout import PublishBlock, SourceStamp
from shmmap.segment.names import new_segment_name
from shmmap.segment.writer import SegmentWriter

Publish = Callable[..., str]


@pytest.fixture
def shm() -> Iterator[ShmDirectory]:
    """Return a directory of its own inside /dev/shm."""
    with tempfile.TemporaryDirectory(prefix="shmmap-unit-", dir="/dev/shm") as path:
        directory = ShmDirectory(path)
        yield directory
        directory.close()


def write_segment(fd: int, xyz: np.ndarray, intensity: np.ndarray, *, cell_id: str = "/map/a.pcd") -> int:
    """Write a cell of two columns; returns the bytes of its header."""
    specs = [ColumnSpec("xyz", xyz.dtype, 3, "m"), ColumnSpec("intensity", intensity.dtype)]
    writer = SegmentWriter(specs, len(xyz), cell_id=cell_id, layer="points", box=(0.0, 0.0, 20.0, 20.0))
    writer.start(fd)
    writer.append(0, xyz)
    writer.append(1, intensity)
    header = writer.finish(
        z_min=0.0,
        z_max=1.0,
        source=SourceStamp(1, 2, 3),
        source_digest=bytes(16),
        source_points=len(xyz),
        dropped_points=0,
        builder_version=1,
    )
    return header.header_bytes


@pytest.fixture
def publish(shm: ShmDirectory) -> Publish:
    """Publish a cell of ``rows`` points; returns its name."""

    def make(rows: int = 100, seed: int = 0, mode: int = 0o400) -> str:
        rng = np.random.default_rng(seed)
        xyz = rng.random((rows, 3)).astype(np.float32)
        intensity = rng.integers(0, 256, rows).astype(np.uint8)
        name = new_segment_name("unit")
        fd = shm.create()
        try:
            header_bytes = write_segment(fd, xyz, intensity)
            shm.publish(
                fd, name, block=PublishBlock(7, 8 + seed), header_bytes=header_bytes, mode=mode, gid=-1
            )
        finally:
            os.close(fd)
        return name

    return make

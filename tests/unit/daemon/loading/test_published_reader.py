# SPDX-License-Identifier: Apache-2.0
"""Objects of a published map, as a loader makes segments of them."""

from __future__ import annotations

import os
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("zstandard", reason="zstandard is not installed")

from shmmap.daemon.loading.published_reader import PublishedReader
from shmmap.errors import MapDataError
from shmmap.layers.points import LAYER
from shmmap.layers.sources import CellJob
from shmmap.layers.spec import layer_spec
from shmmap.origin.remote.opened_store import ServedFrom
from shmmap.origin.remote.published_object import (
    LayerSource,
    ObjectName,
    bare_object,
    pack_object,
    pack_source,
)
from shmmap.segment.layout import SegmentHeader, SourceStamp
from tests.support.segments import write_segment

BOX = (0.0, 0.0, 20.0, 20.0)
BUILDER = 3
"""Version of the builder of the points in the store."""


@pytest.fixture
def points(tmp_path: Path) -> ObjectName:
    """Return the name of an object in a store, the points of a cell."""
    fd = os.memfd_create("segment")
    header = write_segment(
        fd,
        {"xyz": np.ones((5, 3), np.float32)},
        cell_id="",
        source=SourceStamp(0, 0, 0),
        builder_version=BUILDER,
    )
    unpacked = bare_object(memoryview(os.pread(fd, header.total_bytes, 0)))
    os.close(fd)
    name, frame = pack_object(unpacked, sha256(unpacked).digest())
    (tmp_path / name.path).parent.mkdir(parents=True)
    (tmp_path / name.path).write_bytes(frame)
    return name


@pytest.fixture
def fill(points: ObjectName, tmp_path: Path) -> Callable[[int], SegmentHeader | None]:
    """Make a segment of the points, of which the map says that this version of the builder built them."""
    reader, spec = PublishedReader(ServedFrom(str(tmp_path)), "", 0), layer_spec(LAYER)

    def made(builder_version: int) -> SegmentHeader | None:
        source = pack_source("/map/a.pcd", {LAYER: LayerSource(*points, builder_version)})
        job, fd = CellJob("/map/a.pcd", source, BOX, reader=reader, ready=1), os.memfd_create("segment")
        try:
            return reader.fill(spec, job, fd, reserve=None, warn=pytest.fail)
        finally:
            os.close(fd)

    return made


def test_points_are_of_the_builder_that_the_map_names(fill: Callable[[int], SegmentHeader | None]) -> None:
    header = fill(BUILDER)
    assert header is not None
    assert (header.cell_id, header.rows, header.builder_version) == ("/map/a.pcd", 5, BUILDER)


def test_points_of_another_builder_are_damage(fill: Callable[[int], SegmentHeader | None]) -> None:
    """A cell's version says which builder it is of: it would lie."""
    with pytest.raises(MapDataError, match=f"builder version {BUILDER}, the map says {BUILDER + 1}"):
        fill(BUILDER + 1)

# SPDX-License-Identifier: Apache-2.0
"""Columns streamed in any blocks come out whole, with right checksums, for an independent reader."""

from __future__ import annotations

import os
import tempfile
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xxhash
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from shmmap.columns import ColumnSpec
from shmmap.segment.layout import SourceStamp
from shmmap.segment.writer import SegmentWriter
from tests.support.segment_reader import read_segment

DTYPES = ["<f2", "<f4", "<f8", "|i1", "<i2", "<i4", "<i8", "|u1", "<u2", "<u4", "<u8"]
FINISH: dict[str, Any] = {
    "z_min": -1.0,
    "z_max": 2.0,
    "source": SourceStamp(9, 8, 7),
    "source_digest": b"d" * 16,
    "source_points": 12,
    "dropped_points": 2,
    "builder_version": 3,
}


@st.composite
def tables(draw: st.DrawFn) -> tuple[list[NDArray[Any]], list[int]]:
    """Columns of equal row count, and where to cut them into blocks."""
    rows = draw(st.integers(0, 300))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    columns = []
    for dtype in draw(st.lists(st.sampled_from(DTYPES), min_size=1, max_size=6)):
        components = draw(st.integers(1, 4))
        shape = (rows,) if components == 1 else (rows, components)
        nbytes = rows * components * np.dtype(dtype).itemsize
        columns.append(np.frombuffer(rng.bytes(nbytes), dtype).reshape(shape))
    cuts = sorted(draw(st.lists(st.integers(0, rows), max_size=5)))
    return columns, [0, *cuts, rows]


@settings(max_examples=150, deadline=None)
@given(tables())
def test_round_trip(table: tuple[list[NDArray[Any]], list[int]]) -> None:
    columns, cuts = table
    specs = [
        ColumnSpec(f"c{i}", c.dtype, 1 if c.ndim == 1 else c.shape[1], "m" if i else "")
        for i, c in enumerate(columns)
    ]
    rows = len(columns[0])
    writer = SegmentWriter(specs, rows, cell_id="/ä/b.pcd", layer="points", box=(0.0, 1.0, 2.0, 3.0))
    with tempfile.TemporaryFile(dir="/dev/shm") as file:
        writer.start(file.fileno())
        for first, last in pairwise(cuts):
            for index, column in enumerate(columns):
                writer.append(index, np.ascontiguousarray(column[first:last]))
        writer.finish(**FINISH)
        assert os.fstat(file.fileno()).st_size == writer.total_bytes
        read = read_segment(Path(f"/proc/self/fd/{file.fileno()}"))
    assert read.fields["total_bytes"] == writer.total_bytes
    assert read.fields["rows"] == rows
    assert (read.fields["source_points"], read.fields["dropped_points"]) == (12, 2)
    assert (read.epoch, read.version) == (None, None)
    for index, column in enumerate(columns):
        name = f"c{index}"
        assert read.columns[name].dtype == column.dtype
        assert read.columns[name].shape == column.shape
        assert read.columns[name].tobytes() == column.tobytes()
        assert read.checksums[name] == xxhash.xxh3_64_intdigest(column.tobytes())
        assert read.units[name] == ("m" if index else "")


def test_until_it_is_finished_it_is_no_segment() -> None:
    writer = SegmentWriter(
        [ColumnSpec("xyz", np.dtype("<f4"), 3)], 2, cell_id="a", layer="points", box=(0.0, 0.0, 1.0, 1.0)
    )
    with tempfile.TemporaryFile(dir="/dev/shm") as file:
        writer.start(file.fileno())
        writer.append(0, np.zeros((1, 3), "<f4"))
        with pytest.raises(ValueError, match="12 of 24 bytes"):
            writer.finish(**FINISH)
        assert os.pread(file.fileno(), 4096, 0) == bytes(4096)


@pytest.mark.parametrize("rows", [0, 1, 5, 341, 342, 100_003])
def test_every_page_is_allocated(rows: int) -> None:
    writer = SegmentWriter(
        [
            ColumnSpec("xyz", np.dtype("<f4"), 3),
            ColumnSpec("t", np.dtype("u1")),
            ColumnSpec("s", np.dtype("<f8")),
        ],
        rows,
        cell_id="a",
        layer="points",
        box=(0.0, 0.0, 1.0, 1.0),
    )
    with tempfile.TemporaryFile(dir="/dev/shm") as file:
        writer.start(file.fileno())
        writer.append(0, np.ones((rows, 3), "<f4"))
        writer.append(1, np.ones(rows, "u1"))
        writer.append(2, np.ones(rows, "<f8"))
        writer.finish(**FINISH)
        state = os.fstat(file.fileno())
        # a page that is a hole would be allocated by its first reader, or kill it when there is no room
        assert state.st_blocks * 512 == -(-state.st_size // 4096) * 4096

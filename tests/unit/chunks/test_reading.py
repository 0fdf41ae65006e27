# SPDX-License-Identifier: Apache-2.0
"""Copies of a chunk that is being written are whole, and voxels are found where they are."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from shmmap.chunks.layout import ChunkIdentity, ChunkView, chunk_bytes, new_header
from shmmap.chunks.reading import TRIES, read_chunk, select_voxels
from shmmap.chunks.voxels import ChunkKey
from shmmap.errors import BadRequest
from shmmap.live_worker.chunk_memory import ChunkFile, ChunkMemory, live_prefix
from tests.support.chunk_memory import ChunkMemory as Unbounded
from tests.support.daemon_process import LIMIT_S, ROOT, Deadline
from tests.support.live_drive import RESOLUTION, marked

IDENTITY = ChunkIdentity(bytes(16), ChunkKey(3, -1, 0), 0.1, -1992, 3476, 0, 0, 7, "map")
FILLED = 64
"""Bricks: the writer takes some tens of microseconds for them, a copy five."""


@pytest.fixture
def chunk() -> Iterator[tuple[ChunkFile, Path]]:
    with tempfile.TemporaryDirectory(dir="/dev/shm") as path:
        memory = ChunkMemory(path, live_prefix("test", "lidar"))
        one = memory.create(new_header(IDENTITY))
        view = one.grow(FILLED)
        view.index[:FILLED] = np.arange(1, FILLED + 1)
        view.state["bricks"] = FILLED
        yield one, Path(path, one.name[1:])
        one.close()
        memory.close()


@pytest.fixture
def opened(chunk: tuple[ChunkFile, Path]) -> Iterator[int]:
    """Its file, open as a reader has it."""
    fd = os.open(chunk[1], os.O_RDONLY)
    yield fd
    os.close(fd)


@pytest.fixture
def written(chunk: tuple[ChunkFile, Path]) -> Iterator[ChunkView]:
    """A chunk that another process fills with one number after the other, without end."""
    one, path = chunk
    command = [sys.executable, "-m", "tests.support.chunk_memory", str(path), str(FILLED)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=ROOT) as writer:
        try:
            assert writer.stdout is not None
            assert writer.stdout.readline() == b"ready\n"
            yield one.view
        finally:
            writer.kill()


def test_copies_of_what_is_written_are_whole(written: ChunkView, opened: int) -> None:
    """There is no pause between two copies: the writer makes none either."""
    seen: set[int] = set()
    assert written.bricks.size
    copies, end_s = 0, time.monotonic() + LIMIT_S
    while copies < 1000 or len(seen) < 50:
        assert time.monotonic() < end_s, f"{copies} copies of {len(seen)} numbers"
        copy = read_chunk(opened)
        if copy is None:
            continue
        copies += 1
        low, high = int(copy.bricks.min()), int(copy.bricks.max())
        assert low == high, f"copy {copies} is torn"
        seen.add(low)


def test_without_the_sequence_some_are_torn(written: ChunkView) -> None:
    """Else the test above would find nothing."""
    waiting, torn = Deadline(), 0
    while waiting(torn < 3):
        copy = ChunkView(bytes(written.data))
        torn += int(copy.bricks.min()) != int(copy.bricks.max())


def test_a_writer_that_died_in_the_middle_is_not_waited_for(
    chunk: tuple[ChunkFile, Path], opened: int
) -> None:
    view = chunk[0].view
    view.state["sequence"] = 7
    assert read_chunk(opened) is None
    view.state["sequence"] = 8
    copy = read_chunk(opened)
    assert copy is not None
    assert len(copy.data) == chunk_bytes(FILLED)


def test_one_that_changes_all_the_time_is_read_a_bounded_number_of_times(
    monkeypatch: pytest.MonkeyPatch, chunk: tuple[ChunkFile, Path], opened: int
) -> None:
    view, tries, pread = chunk[0].view, 0, os.pread

    def read(fd: int, size: int, at: int) -> bytes:
        nonlocal tries
        if at == 0:
            tries += 1
            view.state["sequence"] += 2
        return pread(fd, size, at)

    monkeypatch.setattr(os, "pread", read)
    assert read_chunk(opened) is None
    assert tries == TRIES


@pytest.mark.parametrize("kind", ["occupied", "free"])
def test_voxels_are_found_where_they_are(kind: str) -> None:
    unbounded = Unbounded(RESOLUTION)
    for number, marks in enumerate(marked(6), 1):
        unbounded.apply(marks, scan=number)
    found = {}
    for view in unbounded.chunks.values():
        indices, log_odds = select_voxels(view, kind)
        assert [indices.dtype.str, log_odds.dtype.str] == ["<i4", "<i2"]
        for voxel, value in zip(indices.tolist(), log_odds.tolist(), strict=True):
            found[tuple(voxel)] = value
    expected = {
        voxel: value for voxel, value in unbounded.voxels().items() if (value > 0) == (kind == "occupied")
    }
    assert found == expected
    assert found


def test_a_kind_that_there_is_not() -> None:
    with pytest.raises(BadRequest, match="voxels are not 'unknown'") as caught:
        select_voxels(ChunkView(new_header(IDENTITY)), "unknown")
    assert "occupied, free" in caught.value.hint

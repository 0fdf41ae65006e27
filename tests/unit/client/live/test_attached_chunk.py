# SPDX-License-Identifier: Apache-2.0
"""Chunks as a reader has them: checked, whole, up to date, and unmapped when they are not needed."""

from __future__ import annotations

import gc
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from shmmap.chunks.layout import HEADER_BYTES, MOST_BYTES, ChunkIdentity, chunk_bytes, new_header
from shmmap.chunks.voxels import BRICKS, ChunkKey
from shmmap.client.live.attached_chunk import AttachedChunk
from shmmap.client.live.chunk_reader import ChunkInfo, ChunkReader, Place
from shmmap.daemon.live.chunk_memory import ChunkFile, ChunkMemory, live_prefix
from shmmap.errors import SegmentCorrupt, SegmentError, StaleHandle
from shmmap.segment.pins import has_slot

KEY = ChunkKey(0, 0, 0)
MAP_ID = bytes(range(16))
IDENTITY = ChunkIdentity(MAP_ID, KEY, 0.1, -1992, 3476, 0, 0, 7, "map")
SLOT = 12345


@pytest.fixture
def directory() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir="/dev/shm") as path:
        yield Path(path)
        gc.collect()
        mapped = Path("/proc/self/maps").read_text()
        assert path not in mapped


@pytest.fixture
def memory(directory: Path) -> Iterator[ChunkMemory]:
    one = ChunkMemory(str(directory), live_prefix("test", "lidar"))
    yield one
    one.close()


def made(memory: ChunkMemory, value: int, identity: ChunkIdentity = IDENTITY) -> ChunkFile:
    """A chunk of one brick that has one value."""
    one = memory.create(new_header(identity))
    view = one.grow(1)
    view.bricks[0] = value
    view.index[0] = 1
    view.state["bricks"] = view.state["version"] = 1
    return one


def path_of(directory: Path, generation: int = 7) -> str:
    return f"{directory}/shmmap-live.test.lidar.0_0_0.{generation}"


def attach(directory: Path, generation: int = 7) -> AttachedChunk:
    return AttachedChunk(path_of(directory, generation), KEY, generation, MAP_ID, SLOT)


def test_what_is_there_is_read_and_locked(memory: ChunkMemory, directory: Path) -> None:
    written = made(memory, 100)
    one = attach(directory)
    assert (one.key, one.generation, one.in_service) == (KEY, 7, True)
    assert int(one.dense().sum()) == 100 * 256
    with open(path_of(directory), "rb") as file:
        assert has_slot(file.fileno(), SLOT)
        one.close()
        assert not has_slot(file.fileno(), SLOT)
    written.close()


def test_it_is_copied_again_when_it_changed(memory: ChunkMemory, directory: Path) -> None:
    written = made(memory, 100)
    one = attach(directory)
    first = one.copy()
    assert one.copy() is first, "nothing has changed"
    written.view.state["sequence"] += 1
    with pytest.raises(StaleHandle, match="being written"):
        one.copy()
    view = written.grow(BRICKS)
    view.bricks[:] = 5
    view.index[:] = np.arange(1, BRICKS + 1)
    view.state["bricks"], view.state["version"] = BRICKS, 2
    view.state["sequence"] += 1
    assert (one.dense() == 5).all()
    assert len(one.copy().data) == MOST_BYTES
    assert int(first.bricks[0, 0]) == 100
    one.close()
    written.close()


def test_what_was_undone_and_done_otherwise_is_seen(memory: ChunkMemory, directory: Path) -> None:
    """The writer died after a change; the next one undid it, and took in another scan first: one version."""
    written = made(memory, 100)
    one = attach(directory)
    assert one.dense()[0] == 100
    written.view.state["sequence"] += 2
    written.view.bricks[0] = 50
    assert one.dense()[0] == 50
    one.close()
    written.close()


def test_what_is_given_up_can_still_be_read(memory: ChunkMemory, directory: Path) -> None:
    written = made(memory, 100)
    one = attach(directory)
    kept = memory.give_up(written)
    assert not one.in_service
    assert one.dense()[0] == 100
    with pytest.raises(StaleHandle, match="the chunk is gone"):
        attach(directory)
    one.close()
    memory.forget(kept)


def fifo(path: Path) -> None:
    os.mkfifo(path)


def link(path: Path) -> None:
    path.symlink_to("/etc/passwd")


def folder(path: Path) -> None:
    path.mkdir()


def content(data: bytes) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        path.write_bytes(data)

    return write


@pytest.mark.parametrize(
    ("make", "error", "said"),
    [
        (fifo, SegmentCorrupt, "its size cannot be"),
        (link, SegmentError, "symbolic links"),
        (folder, SegmentError, "."),
        (content(b""), SegmentCorrupt, "its size cannot be"),
        (content(bytes(HEADER_BYTES - 1)), SegmentCorrupt, "its size cannot be"),
        (content(bytes(MOST_BYTES + 1)), SegmentCorrupt, "its size cannot be"),
        (content(bytes(HEADER_BYTES)), SegmentCorrupt, "no chunk"),
        (content(bytes(new_header(replace(IDENTITY, generation=8)))), SegmentCorrupt, "another chunk"),
        (content(bytes(new_header(replace(IDENTITY, map_id=bytes(16))))), SegmentCorrupt, "another chunk"),
        (content(bytes(new_header(replace(IDENTITY, key=ChunkKey(1, 0, 0))))), SegmentCorrupt, "another"),
    ],
)
def test_what_is_no_chunk(
    directory: Path, make: Callable[[Path], None], error: type[Exception], said: str
) -> None:
    make(Path(path_of(directory)))
    before = len(os.listdir("/proc/self/fd"))
    with pytest.raises(error, match=said):
        attach(directory)
    assert len(os.listdir("/proc/self/fd")) == before


def test_one_that_says_it_is_longer_than_chunks_are(memory: ChunkMemory, directory: Path) -> None:
    written = made(memory, 100)
    written.view.state["bricks"] = BRICKS + 5
    one = attach(directory)
    with pytest.raises(SegmentCorrupt, match="1029 bricks"):
        one.copy()
    one.close()
    written.close()


# --- the reader of many -------------------------------------------------------------------------


def reader(directory: Path, rows: dict[ChunkKey, ChunkInfo]) -> ChunkReader:
    place = Place(f"{directory}/shmmap-live.test.lidar.", MAP_ID, SLOT, 0.1, 0)
    return ChunkReader(lambda: place, lambda _since: (rows, [], 1, True))


def info(generation: int) -> ChunkInfo:
    return ChunkInfo(KEY, "clean", 256, 256, 0, chunk_bytes(1), 1, generation)


def test_another_generation_is_mapped_instead(memory: ChunkMemory, directory: Path) -> None:
    """Also where the old one still says that it is in service: its names were removed by somebody."""
    old = made(memory, 100)
    rows = {KEY: info(7)}
    one = reader(directory, rows)
    here = np.array([[0.05, 0.05, 0.05]])
    assert one.look_up(here).tolist() == [100]
    memory.remove(old.name)
    new = made(memory, 30, replace(IDENTITY, generation=8))
    rows[KEY] = info(8)
    assert one.look_up(here).tolist() == [30]
    rows.clear()
    assert one.look_up(here).tolist() == [0], "it is on disk alone"
    old.close()
    new.close()


def test_what_is_gone_before_it_is_mapped_is_asked_for_again(memory: ChunkMemory, directory: Path) -> None:
    new = made(memory, 30, replace(IDENTITY, generation=8))
    asked: list[int] = []

    def changes(since: int) -> tuple[dict[ChunkKey, ChunkInfo], list[ChunkKey], int, bool]:
        asked.append(since)
        return {KEY: info(7 if len(asked) < 3 else 8)}, [], len(asked), True

    place = Place(f"{directory}/shmmap-live.test.lidar.", MAP_ID, SLOT, 0.1, 0)
    one = ChunkReader(lambda: place, changes)
    assert one.look_up(np.array([[0.05, 0.05, 0.05]])).tolist() == [30]
    assert asked == [0, 1, 2]
    never = ChunkReader(lambda: place, lambda _since: ({KEY: info(7)}, [], 1, True))
    with pytest.raises(SegmentError, match="ask again"):
        never.look_up(np.array([[0.05, 0.05, 0.05]]))
    del one
    new.close()

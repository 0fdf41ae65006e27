# SPDX-License-Identifier: Apache-2.0
"""Chunks as a reader has them: whole, up to date, checked, and nothing of them held."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from shmmap.chunks import reading
from shmmap.chunks.layout import HEADER_BYTES, MAX_BYTES, ChunkIdentity, ChunkView, chunk_bytes, new_header
from shmmap.chunks.voxels import BRICKS, ChunkKey
from shmmap.client.live import chunk_reader
from shmmap.client.live.chunk_reader import ChunkInfo, ChunkReader, Place
from shmmap.errors import SegmentCorrupt, SegmentError
from shmmap.live_worker.chunk_memory import ChunkFile, ChunkMemory, live_prefix
from tests.support.daemon_process import ROOT

KEY = ChunkKey(0, 0, 0)
MAP_ID = bytes(range(16))
IDENTITY = ChunkIdentity(MAP_ID, KEY, 0.1, -1992, 3476, 0, 0, 7, "map")
HERE = np.array([[0.05, 0.05, 0.05]])


@pytest.fixture
def directory() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir="/dev/shm") as path:
        yield Path(path)


@pytest.fixture
def memory(directory: Path) -> Iterator[ChunkMemory]:
    one = ChunkMemory(str(directory), live_prefix("test", "lidar"))
    yield one
    one.close()


def made(memory: ChunkMemory, value: int, identity: ChunkIdentity = IDENTITY, bricks: int = 1) -> ChunkFile:
    """A chunk of some bricks that has one value."""
    one = memory.create(new_header(identity))
    view = one.grow(bricks)
    view.bricks[:bricks] = value
    view.index[:bricks] = np.arange(1, bricks + 1)
    view.state["bricks"], view.state["version"] = bricks, 1
    return one


def path_of(directory: Path, generation: int = 7) -> str:
    return f"{directory}/shmmap-live.test.lidar.0_0_0.{generation}"


def info(generation: int) -> ChunkInfo:
    return ChunkInfo(KEY, "clean", 256, 256, 0, chunk_bytes(1), 1, generation)


def reader(directory: Path, rows: dict[ChunkKey, ChunkInfo]) -> ChunkReader:
    place = Place(f"{directory}/shmmap-live.test.lidar.", MAP_ID, 0.1, 0)
    return ChunkReader(lambda: place, lambda _since: (rows, [], 1, True))


def open_files(directory: Path) -> list[str]:
    """What this process has open or mapped there."""
    there = []
    for fd in os.listdir("/proc/self/fd"):
        with contextlib.suppress(FileNotFoundError):  # that of this directory
            there.append(os.readlink(f"/proc/self/fd/{fd}"))
    mapped = Path("/proc/self/maps").read_text().splitlines()
    return [name for name in [*there, *mapped] if f"{directory}/" in name]


def test_it_is_read_again_when_it_changed(
    monkeypatch: pytest.MonkeyPatch, memory: ChunkMemory, directory: Path
) -> None:
    reads: list[int] = []

    def counted(fd: int, name: str) -> ChunkView | None:
        reads.append(fd)
        return reading.read_chunk(fd, name)

    monkeypatch.setattr(chunk_reader, "read_chunk", counted)
    written = made(memory, 100)
    one = reader(directory, {KEY: info(7)})
    for _ in range(3):
        assert one.look_up(HERE).tolist() == [100]
    assert len(reads) == 1, "nothing has changed"
    written.view.state["sequence"] += 1
    monkeypatch.setattr(reading, "TRIES", 3)
    with pytest.raises(SegmentError, match="written and given up all the time"):
        one.look_up(HERE)
    view = written.grow(BRICKS)
    view.bricks[:] = 5
    view.index[:] = np.arange(1, BRICKS + 1)
    view.state["bricks"], view.state["version"] = BRICKS, 2
    view.state["sequence"] += 1
    points = np.random.default_rng(1).uniform(0.0, 6.4, (1000, 3))
    assert (one.look_up(points) == 5).all()
    written.close()


def test_what_was_undone_and_done_otherwise_is_seen(memory: ChunkMemory, directory: Path) -> None:
    """The writer died after a change; the next one undid it, and took in another scan first: one version."""
    written = made(memory, 100)
    one = reader(directory, {KEY: info(7)})
    assert one.look_up(HERE).tolist() == [100]
    written.view.state["sequence"] += 2
    written.view.bricks[0] = 50
    assert one.look_up(HERE).tolist() == [50]
    written.close()


def test_nothing_is_held(memory: ChunkMemory, directory: Path) -> None:
    """No descriptor and no mapping, whatever was read."""
    written = made(memory, 100)
    one = reader(directory, {KEY: info(7)})
    written.close()
    assert not open_files(directory)
    assert one.look_up(HERE).tolist() == [100]
    assert not open_files(directory)


def test_what_is_given_up_is_not_served_from_a_copy(memory: ChunkMemory, directory: Path) -> None:
    """Another chunk may have its key by then: a reader with a copy asks which one."""
    written = made(memory, 100)
    rows = {KEY: info(7)}
    one = reader(directory, rows)
    assert one.look_up(HERE).tolist() == [100]
    memory.give_up(written)
    with pytest.raises(SegmentError, match="ask again"):
        one.look_up(HERE)
    rows.clear()
    assert one.look_up(HERE).tolist() == [0]


def test_a_name_that_another_file_has_is_read_again(memory: ChunkMemory, directory: Path) -> None:
    """Also where generation and sequence are the same: a map's directory was brought back from a copy."""
    first = made(memory, 100)
    one = reader(directory, {KEY: info(7)})
    assert one.look_up(HERE).tolist() == [100]
    memory.remove(first.name)
    second = made(memory, 30)
    assert one.look_up(HERE).tolist() == [30]
    first.close()
    second.close()


# --- races -------------------------------------------------------------------------------------


@pytest.mark.parametrize("when", ["opened", "sequence", "header", "all"])
def test_a_chunk_that_is_given_up_while_it_is_read_is_asked_for_again(
    monkeypatch: pytest.MonkeyPatch, memory: ChunkMemory, directory: Path, when: str
) -> None:
    """After the file was opened, after each of its parts was read: never a voxel of what is no more."""
    old, rows = made(memory, 100, bricks=8), {KEY: info(7)}
    one = reader(directory, rows)
    after = {"opened": 0, "sequence": 1, "header": 2, "all": 3}[when]
    calls = 0
    pread, fstat = os.pread, os.fstat

    def give_up() -> None:
        if KEY in rows and rows[KEY].generation == 7:
            memory.give_up(old)
            new.append(made(memory, 30, replace(IDENTITY, generation=8)))
            rows[KEY] = info(8)

    new: list[ChunkFile] = []

    def read(fd: int, size: int, at: int) -> bytes:
        nonlocal calls
        data = pread(fd, size, at)
        calls += 1
        if calls == after:
            give_up()
        return data

    def status(fd: int) -> os.stat_result:
        found = fstat(fd)
        if after == 0:
            give_up()
        return found

    monkeypatch.setattr(os, "pread", read)
    monkeypatch.setattr(os, "fstat", status)
    # what was whole before it was given up may count: it was so when it was read
    assert one.look_up(HERE).tolist() == ([100] if when == "all" else [30])
    assert one.look_up(HERE).tolist() == [30]
    for file in new:
        file.close()


def test_a_chunk_that_is_written_while_it_is_read_is_read_again(
    monkeypatch: pytest.MonkeyPatch, memory: ChunkMemory, directory: Path
) -> None:
    """It grows as well: what was read is shorter than what it says then."""
    written = made(memory, 100)
    one = reader(directory, {KEY: info(7)})
    pread, calls = os.pread, 0

    def read(fd: int, size: int, at: int) -> bytes:
        nonlocal calls
        calls += 1
        if calls == 2:
            view = written.grow(BRICKS)
            view.state["sequence"] += 2
            view.bricks[:] = 5
            view.index[:] = np.arange(1, BRICKS + 1)
            view.state["bricks"] = BRICKS
        return pread(fd, size, at)

    monkeypatch.setattr(os, "pread", read)
    assert one.look_up(np.array([[6.35, 6.35, 6.35]])).tolist() == [5]
    assert calls == 6
    written.close()


def test_a_reader_that_is_stopped_anywhere_reads_no_wrong_voxel(memory: ChunkMemory, directory: Path) -> None:
    """Each generation has one value in all voxels: its own number."""
    program = """
import sys
import numpy as np
from shmmap.client.live.chunk_reader import ChunkInfo, ChunkReader, Place
from shmmap.chunks.voxels import ChunkKey
from shmmap.errors import SegmentError
key, prefix = ChunkKey(0, 0, 0), sys.argv[1]
def changes(since):
    with open(prefix + "now") as file:
        text = file.read()
    rows = {key: ChunkInfo(key, "clean", 1, 1, 0, 1, 1, int(text))} if text else {}
    return rows, [key], 1, False
one = ChunkReader(lambda: Place(prefix, bytes(range(16)), 0.1, 0), changes)
points = np.random.default_rng(1).uniform(0.0, 6.4, (200, 3))
last = 0
print("ready", flush=True)
while True:
    try:
        values = set(one.look_up(points).tolist())
    except SegmentError:
        continue
    assert len(values) == 1, f"torn: {values}"
    (value,) = values
    assert value == 0 or value >= last, f"{value} after {last}"
    last = max(last, value)
    if value >= 60:
        break
"""
    prefix = f"{directory}/shmmap-live.test.lidar."
    Path(prefix + "now").write_text("")
    rng = np.random.default_rng(4)
    with subprocess.Popen(
        [sys.executable, "-c", program, prefix], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        cwd=ROOT,
    ) as process:  # fmt: skip
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            one = None
            for generation in range(1, 61):
                one = made(memory, generation, replace(IDENTITY, generation=generation), BRICKS)
                Path(prefix + "interim").write_text(str(generation))
                Path(prefix + "interim").rename(prefix + "now")
                time.sleep(rng.uniform(0.0, 0.01))  # it is anywhere then
                process.send_signal(signal.SIGSTOP)
                if generation < 60:
                    memory.give_up(one)
                process.send_signal(signal.SIGCONT)
            _, said = process.communicate(timeout=60)
            assert process.returncode == 0, said
            assert one is not None
            one.close()
        finally:
            process.kill()


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
        (fifo, SegmentError, "Illegal seek"),
        (link, SegmentError, "symbolic links"),
        (folder, SegmentError, "."),
        (content(b""), SegmentError, "given up all the time"),
        (content(bytes(HEADER_BYTES - 1)), SegmentCorrupt, "cannot be a chunk"),
        (content(bytes(MAX_BYTES + 1)), SegmentCorrupt, "cannot be a chunk"),
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
        reader(directory, {KEY: info(7)}).look_up(HERE)
    assert len(os.listdir("/proc/self/fd")) == before


def test_one_that_says_it_is_longer_than_chunks_are(memory: ChunkMemory, directory: Path) -> None:
    written = made(memory, 100)
    written.view.state["bricks"] = BRICKS + 5
    with pytest.raises(SegmentCorrupt, match="1029 bricks"):
        reader(directory, {KEY: info(7)}).look_up(HERE)
    written.view.state["bricks"] = 1
    written.view.index[5] = 9
    with pytest.raises(SegmentCorrupt, match="1 bricks"):
        reader(directory, {KEY: info(7)}).look_up(HERE)
    written.close()


# --- the reader of many -------------------------------------------------------------------------


def test_another_generation_is_read_instead(memory: ChunkMemory, directory: Path) -> None:
    """Also where the old one still says that it is in service: another process removed its names."""
    old = made(memory, 100)
    rows = {KEY: info(7)}
    one = reader(directory, rows)
    assert one.look_up(HERE).tolist() == [100]
    memory.remove(old.name)
    new = made(memory, 30, replace(IDENTITY, generation=8))
    rows[KEY] = info(8)
    assert one.look_up(HERE).tolist() == [30]
    rows.clear()
    assert one.look_up(HERE).tolist() == [0], "it is on disk alone"
    old.close()
    new.close()


def test_what_is_gone_before_it_is_read_is_asked_for_again(memory: ChunkMemory, directory: Path) -> None:
    new = made(memory, 30, replace(IDENTITY, generation=8))
    asked: list[int] = []

    def changes(since: int) -> tuple[dict[ChunkKey, ChunkInfo], list[ChunkKey], int, bool]:
        asked.append(since)
        return {KEY: info(7 if len(asked) < 3 else 8)}, [], len(asked), True

    place = Place(f"{directory}/shmmap-live.test.lidar.", MAP_ID, 0.1, 0)
    one = ChunkReader(lambda: place, changes)
    assert one.look_up(np.array([[0.05, 0.05, 0.05]])).tolist() == [30]
    assert asked == [0, 1, 2]
    never = ChunkReader(lambda: place, lambda _since: ({KEY: info(7)}, [], 1, True))
    with pytest.raises(SegmentError, match="ask again"):
        never.look_up(np.array([[0.05, 0.05, 0.05]]))
    del one
    new.close()

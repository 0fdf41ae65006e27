# SPDX-License-Identifier: Apache-2.0
"""Chunks in shared memory: they grow in place, readers keep nothing of them, the next writer finds them."""

from __future__ import annotations

import errno
import os
import resource
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from shmmap.chunks.layout import (
    HEADER_BYTES,
    MAX_BYTES,
    ChunkIdentity,
    chunk_bytes,
    new_header,
)
from shmmap.chunks.voxels import BRICKS, ChunkKey
from shmmap.errors import CannotStart, SegmentCorrupt
from shmmap.live_worker import chunk_memory
from shmmap.live_worker.chunk_memory import ChunkFile, ChunkMemory, live_prefix
from tests.support.accounts import MEMBER
from tests.support.daemon_process import open_files
from tests.support.odd_files import failing

PREFIX = live_prefix("test", "lidar")
IDENTITY = ChunkIdentity(bytes(16), ChunkKey(3, -1, 0), 0.1, -1992, 3476, 0, 0, 7, "map")
NAME = f"{PREFIX}3_-1_0.7"


@pytest.fixture
def directory() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir="/dev/shm") as path:
        yield Path(path)
        assert os.listdir(path) == []


@pytest.fixture
def memory(directory: Path) -> Iterator[ChunkMemory]:
    one = ChunkMemory(str(directory), PREFIX)
    yield one
    for name, _, _ in list(one.names()):
        one.remove(name)
    one.close()
    assert not [path for path in open_files().values() if path.startswith(str(directory))]
    assert not [line for line in Path("/proc/self/maps").read_text().splitlines() if str(directory) in line]


def fill(chunk: ChunkFile, bricks: int) -> None:
    """Fill ``bricks`` bricks, each with its number in all voxels."""
    view = chunk.grow(bricks)
    for number in range(bricks):
        view.bricks[number] = number + 1
        view.index[number] = number + 1
    view.state["bricks"] = bricks


def test_a_chunk_is_made_grows_and_is_found_again(memory: ChunkMemory, directory: Path) -> None:
    chunk = memory.create(new_header(IDENTITY))
    assert chunk.name == NAME
    assert list(memory.names()) == [(NAME, IDENTITY.key, 7)]
    assert (chunk.nbytes, len(chunk.view.bricks)) == (HEADER_BYTES, 0)
    fill(chunk, 5)
    assert (chunk.nbytes, len(chunk.view.bricks)) == (2 * 4096, 8)
    fill(chunk, BRICKS)
    assert chunk.nbytes == MAX_BYTES
    chunk.close()
    again = memory.open(NAME)
    assert again.view.identity == IDENTITY
    assert (again.view.bricks == np.arange(1, BRICKS + 1)[:, None]).all()
    again.close()
    assert (directory / NAME[1:]).stat().st_size == MAX_BYTES


def test_what_is_given_up_is_free_at_once_whatever_others_have_of_it(
    memory: ChunkMemory, directory: Path
) -> None:
    """Open, mapped, or looked at: its memory is free, and a reader gets a signal, not a zero."""
    chunk = memory.create(new_header(IDENTITY))
    fill(chunk, BRICKS)
    program = f"""
import mmap, os, sys
fd = os.open({str(directory / NAME[1:])!r}, os.O_RDONLY)
data = mmap.mmap(fd, 0, prot=mmap.PROT_READ)
assert data[4096] == 1
print("mapped", flush=True)
sys.stdin.readline()
assert os.fstat(fd).st_size == 0 and not os.pread(fd, 8, 0)
print(data[4096], flush=True)
"""
    with subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as reader:
        assert reader.stdin is not None
        assert reader.stdout is not None
        assert reader.stdout.readline() == "mapped\n"
        status = (directory / NAME[1:]).stat()
        assert status.st_blocks * 512 == MAX_BYTES
        fd = os.open(directory / NAME[1:], os.O_RDONLY)
        memory.give_up(chunk)
        assert not list(directory.iterdir())
        assert os.fstat(fd).st_blocks == 0
        os.close(fd)
        out, _ = reader.communicate("go on\n", timeout=60)
        assert (out, reader.returncode) == ("", -signal.SIGBUS)


def test_a_writer_that_died_while_it_gave_a_chunk_up_leaves_nothing_to_adopt(
    memory: ChunkMemory, directory: Path
) -> None:
    memory.create(new_header(IDENTITY)).close()
    assert not memory.is_given_up(NAME)
    os.truncate(directory / NAME[1:], 0)
    assert memory.is_given_up(NAME)


def test_where_there_is_no_memory_nothing_changes(memory: ChunkMemory, directory: Path) -> None:
    """A full file system, or a limit: an error, no signal, and the chunk is as it was."""
    chunk = memory.create(new_header(IDENTITY))
    fill(chunk, 8)
    program = f"""
import os, resource, signal, sys
from shmmap.live_worker.chunk_memory import ChunkMemory
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
memory = ChunkMemory({str(directory)!r}, {PREFIX!r})
chunk = memory.open({NAME!r})
resource.setrlimit(resource.RLIMIT_FSIZE, (65536, 65536))
try:
    chunk.grow(500)
except OSError as error:
    print(error.errno, len(chunk.view.bricks), int(chunk.view.bricks[7, 0]))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout.split() == [str(errno.EFBIG), "8", "8"], done.stderr
    chunk.close()
    assert resource.getrlimit(resource.RLIMIT_FSIZE)[0] == resource.RLIM_INFINITY


def test_where_nothing_more_can_be_mapped_no_name_stays(
    monkeypatch: pytest.MonkeyPatch, memory: ChunkMemory, directory: Path
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(chunk_memory, "map_chunk", failing(errno.ENOMEM))
        with pytest.raises(OSError, match="Cannot allocate memory"):
            memory.create(new_header(IDENTITY))
    assert list(directory.iterdir()) == []


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "0 bytes"),
        (bytes(HEADER_BYTES), "no chunk"),
        (bytes(new_header(IDENTITY)) + b"x", "4097 bytes"),
        (bytes(new_header(IDENTITY)) + bytes(chunk_bytes(BRICKS)), "bytes cannot be a chunk"),
        (bytes(new_header(replace(IDENTITY, generation=8))), "it is chunk 3_-1_0 8"),
        (bytes(new_header(replace(IDENTITY, key=ChunkKey(0, 0, 0)))), "it is chunk 0_0_0 7"),
    ],
)
def test_what_is_no_chunk_is_not_taken_for_one(
    memory: ChunkMemory, directory: Path, content: bytes, said: str
) -> None:
    (directory / NAME[1:]).write_bytes(content)
    with pytest.raises(SegmentCorrupt, match=said):
        memory.open(NAME)


def test_what_has_another_name_is_not_looked_at(memory: ChunkMemory, directory: Path) -> None:
    others = ["shmmap.test.0123456789abcdef", NAME[1:] + ".x", f"{PREFIX[1:]}1_2.3", f"{PREFIX[1:]}01_2_3.4"]
    for name in others:
        (directory / name).touch()
    assert list(memory.names()) == []
    for name in others:
        (directory / name).unlink()


def test_a_link_or_a_pipe_of_that_name_is_refused(memory: ChunkMemory, directory: Path) -> None:
    (directory / NAME[1:]).symlink_to("/etc/passwd")
    with pytest.raises(OSError, match="symbolic links"):
        memory.open(NAME)
    (directory / NAME[1:]).unlink()
    os.mkfifo(directory / NAME[1:])
    with pytest.raises(SegmentCorrupt, match="0 bytes"):
        memory.open(NAME)


def test_a_record_is_kept_while_there_are_chunks(memory: ChunkMemory, directory: Path) -> None:
    path = directory / f"{PREFIX[1:]}undo"
    memory.record("undo", 8192)[100:103] = b"abc"
    assert (path.stat().st_size, path.stat().st_mode & 0o777) == (8192, 0o600)
    memory.create(new_header(IDENTITY)).close()
    again = ChunkMemory(str(directory), PREFIX)
    again.close()
    assert bytes(memory.record("undo", 8192)[100:103]) == b"abc"
    memory.remove(NAME)
    ChunkMemory(str(directory), PREFIX).close()
    assert not path.exists()


@pytest.mark.parametrize("kind", ["pipe", "link", pytest.param("another user's", marks=pytest.mark.root)])
def test_a_record_that_others_could_write_is_refused(
    memory: ChunkMemory, directory: Path, tmp_path: Path, kind: str
) -> None:
    """An account that could write it could change chunks."""
    path = directory / f"{PREFIX[1:]}undo"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "link":
        path.symlink_to(tmp_path / "elsewhere")
    else:
        path.write_bytes(bytes(100))
        os.chown(path, MEMBER, -1)
    with pytest.raises((CannotStart, OSError), match=r"is not a file of this user|symbolic links"):
        memory.record("undo", 8192)
    assert not (tmp_path / "elsewhere").exists()
    path.unlink()

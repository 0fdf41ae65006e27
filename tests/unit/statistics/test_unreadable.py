# SPDX-License-Identifier: Apache-2.0
"""What is absent, garbage, cut short, half written or forbidden does not mislead a reader."""

from __future__ import annotations

import os
import struct
import threading
import zlib
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from shmmap.errors import NotPermitted, SegmentCorrupt
from shmmap.segment.directory import ShmDirectory
from shmmap.statistics.identity import DaemonIdentity
from shmmap.statistics.reader import StatisticsReader, read_statistics
from shmmap.statistics.writer import StatisticsWriter


@pytest.mark.parametrize("kind", ["pipe", "directory", "link"])
def test_no_file_at_all(shm: ShmDirectory, kind: str) -> None:
    path = f"{shm.path}/shmmap.unit.statistics"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "directory":
        os.mkdir(path)
    else:
        os.symlink("/dev/null", path)
    with closing(StatisticsReader("unit", shm.path)) as reader:
        for _ in range(2):
            with pytest.raises(SegmentCorrupt):
                reader.snapshot()
    os.rmdir(path) if kind == "directory" else os.unlink(path)


def test_garbage_is_refused(shm: ShmDirectory) -> None:
    path = Path(shm.path, "shmmap.unit.statistics")
    for content in (b"", b"x" * 10, bytes(100_000), os.urandom(100_000)):
        path.write_bytes(content)
        with pytest.raises(SegmentCorrupt):
            read_statistics("unit", shm.path)


@pytest.mark.parametrize("keep", [65, 3000, 20_000, 36_000, 50_000, 100_000])
def test_cut_short_is_refused(shm: ShmDirectory, writer: StatisticsWriter, keep: int) -> None:
    path = Path(shm.path, "shmmap.unit.statistics")
    whole = path.read_bytes()
    Path(shm.path, "shmmap.cut.statistics").write_bytes(whole[: min(keep, len(whole) - 1)])
    with pytest.raises(SegmentCorrupt):
        read_statistics("cut", shm.path)
    Path(shm.path, "shmmap.cut.statistics").unlink()


@pytest.mark.parametrize("at", range(16, 56, 4))
@pytest.mark.parametrize("lie", [0, 0xFFFFFFF0])
def test_offsets_and_counts_are_compared_with_the_size(
    shm: ShmDirectory, writer: StatisticsWriter, at: int, lie: int
) -> None:
    """Also those of a header whose checksum is right: what lies outside is refused, or is not there."""
    data = bytearray(Path(shm.path, "shmmap.unit.statistics").read_bytes())
    descriptions, size, counters, histograms = struct.unpack_from("<IIII", data, 16)
    described = bytes(data[descriptions : descriptions + (counters + histograms) * size])
    data[at : at + 4] = lie.to_bytes(4, "little")
    data[60:64] = zlib.crc32(bytes(data[:60]) + described).to_bytes(4, "little")
    Path(shm.path, "shmmap.lies.statistics").write_bytes(data)
    try:
        seen = read_statistics("lies", shm.path)
    except SegmentCorrupt:
        pass
    else:
        assert at in (48, 52), "one of the blocks, or the descriptions, lie elsewhere"
        assert seen.counters == read_statistics("unit", shm.path).counters
        assert not lie or not seen.histograms
    finally:
        Path(shm.path, "shmmap.lies.statistics").unlink()


@pytest.mark.root
def test_another_account_may_not_read(shm: ShmDirectory, writer: StatisticsWriter) -> None:
    os.chmod(shm.path, 0o755)
    os.seteuid(65534)
    try:
        with pytest.raises(NotPermitted):
            read_statistics("unit", shm.path)
    finally:
        os.seteuid(0)


def test_half_written_blocks_are_survived(shm: ShmDirectory, writer: StatisticsWriter) -> None:
    """Tear whatever the writer would write next: the rest is still right."""
    writer.add("requests")
    writer.beat()
    path = Path(shm.path, "shmmap.unit.statistics")
    data = bytearray(path.read_bytes())
    identity_at, identity_bytes, state_at, state_bytes = struct.unpack_from("<IIII", data, 32)
    newest = int.from_bytes(data[state_at : state_at + 8], "little") < int.from_bytes(
        data[state_at + state_bytes : state_at + state_bytes + 8], "little"
    )
    older = state_at + (0 if newest else state_bytes)
    data[older : older + 20] = os.urandom(20)
    data[identity_at : identity_at + 10] = os.urandom(10)  # block 0 was never written
    Path(shm.path, "shmmap.torn.statistics").write_bytes(data)
    seen = read_statistics("torn", shm.path)
    assert seen.counters["requests"] == 1
    assert seen.identity is not None
    assert seen.identity.instance == "unit"
    assert identity_bytes == 16384
    Path(shm.path, "shmmap.torn.statistics").unlink()


def test_readers_see_whole_states_while_the_writer_writes(
    shm: ShmDirectory, identity: DaemonIdentity
) -> None:
    """Two counters always move together."""
    writer = StatisticsWriter(shm, "unit", identity)
    stop = threading.Event()

    def write() -> None:
        count = 0
        while not stop.is_set():
            count += 1
            writer.set("requests", count)
            writer.set("replies", 2 * count)
            writer.update_identity(replace(identity, epoch=count))
            writer.beat()

    thread = threading.Thread(target=write)
    thread.start()
    try:
        for _ in range(300):
            seen = read_statistics("unit", shm.path)
            assert seen.counters["replies"] == 2 * seen.counters["requests"]
            assert seen.identity is not None
    finally:
        stop.set()
        thread.join()
        writer.close()

# SPDX-License-Identifier: Apache-2.0
"""What is absent, garbage, cut short, half written or forbidden does not mislead a reader."""

from __future__ import annotations

import os
import struct
import threading
import zlib
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest

from shmmap.errors import NotPermitted, SegmentCorrupt
from shmmap.segment.directory import ShmDirectory
from shmmap.statistics.identity import DaemonIdentity
from shmmap.statistics.reader import StatisticsReader, read_statistics
from shmmap.statistics.writer import StatisticsWriter
from tests.unit.statistics.conftest import row


@pytest.mark.parametrize("kind", ["pipe", "directory", "link"])
def test_no_file_at_all(shm: ShmDirectory, kind: str) -> None:
    path = f"{shm.path}/shmmap.unit.statistics"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "directory":
        os.mkdir(path)
    else:
        os.symlink("/dev/null", path)
    with StatisticsReader("unit", shm.path) as reader:
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


@pytest.mark.parametrize("at", [16, 20, 24, 28, 32, 36, 40, 44, 48, 52, 56, 64, 68, 72, 76, 80])
def test_offsets_and_counts_are_compared_with_the_size(
    shm: ShmDirectory, writer: StatisticsWriter, at: int
) -> None:
    """Also those of a header whose checksums are right: what lies outside is refused, or is no row."""
    writer.cell_changed(1, row(1))
    writer.beat()
    data = bytearray(Path(shm.path, "shmmap.unit.statistics").read_bytes())
    descriptions, count, size = struct.unpack_from("<III", data, 16)
    counters_end = descriptions + count * size
    histograms_end = counters_end + int.from_bytes(data[64:68], "little") * size
    data[at : at + 4] = b"\xf0\xff\xff\xff"
    data[60:64] = zlib.crc32(bytes(data[:60] + data[descriptions:counters_end])).to_bytes(4, "little")
    extension = bytes(data[64:124] + data[counters_end:histograms_end])
    data[124:128] = zlib.crc32(extension).to_bytes(4, "little")
    Path(shm.path, "shmmap.lies.statistics").write_bytes(data)
    truth = read_statistics("unit", shm.path)
    try:
        seen = read_statistics("lies", shm.path)
    except SegmentCorrupt:
        pass
    else:
        assert at > 44, "one of the blocks lies outside"
        assert truth.cells
        assert seen.cells in ([], truth.cells)
        assert seen.clients in ([], truth.clients)
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


def test_half_written_blocks_and_rows_are_survived(shm: ShmDirectory, writer: StatisticsWriter) -> None:
    """Tear whatever the writer would write next: the rest is still right."""
    for number in range(3):
        writer.cell_changed(number, row(number))
    writer.add("requests")
    writer.beat()
    path = Path(shm.path, "shmmap.unit.statistics")
    data = bytearray(path.read_bytes())
    words = [int.from_bytes(data[at : at + 4], "little") for at in range(16, 64, 4)]
    identity_at, identity_bytes, state_at, state_bytes, table_at, rows_at = words[3:9]
    newest = int.from_bytes(data[state_at : state_at + 8], "little") < int.from_bytes(
        data[state_at + state_bytes : state_at + state_bytes + 8], "little"
    )
    older = state_at + (0 if newest else state_bytes)
    data[older : older + 20] = os.urandom(20)
    data[identity_at : identity_at + 10] = os.urandom(10)  # block 0 was never written
    data[table_at] |= 1
    data[rows_at + 256 + 13] ^= 0xFF
    Path(shm.path, "shmmap.torn.statistics").write_bytes(data)
    seen = read_statistics("torn", shm.path)
    assert seen.counters["requests"] == 1
    assert [c.version for c in seen.cells] == [0, 2]
    assert seen.identity is not None
    assert seen.identity.instance == "unit"
    assert identity_bytes == 16384
    Path(shm.path, "shmmap.torn.statistics").unlink()


def test_readers_see_whole_states_while_the_writer_writes(
    shm: ShmDirectory, identity: DaemonIdentity
) -> None:
    """Two counters always move together, and a table copied as of one moment is whole."""
    writer = StatisticsWriter(shm, "unit", identity)
    stop = threading.Event()

    def write() -> None:
        count = 0
        while not stop.is_set():
            count += 1
            writer.set("requests", count)
            writer.set("replies", 2 * count)
            for key in range(3):
                writer.cell_changed(key, msgspec.structs.replace(row(key), hits=count))
            writer.update_identity(replace(identity, epoch=count))
            writer.beat()

    thread = threading.Thread(target=write)
    thread.start()
    try:
        for _ in range(300):
            seen = read_statistics("unit", shm.path)
            assert seen.counters["replies"] == 2 * seen.counters["requests"]
            assert seen.identity is not None
            assert all(cell.segment == f"{cell.version:016x}" for cell in seen.cells)
    finally:
        stop.set()
        thread.join()
        writer.close()

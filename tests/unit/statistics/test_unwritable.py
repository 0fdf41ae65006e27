# SPDX-License-Identifier: Apache-2.0
"""What finds no room, or may not be written, is written as soon as it can be; names that others have."""

from __future__ import annotations

import contextlib
import os
import pwd
import resource
from collections.abc import Iterator
from dataclasses import replace

import pytest

from shmmap.errors import CannotStart
from shmmap.segment.directory import ShmDirectory
from shmmap.statistics.counters import COUNTERS, HISTOGRAMS
from shmmap.statistics.identity import DaemonIdentity
from shmmap.statistics.layout import CELL_ROW_BYTES, CLIENT_ROW_BYTES, plan
from shmmap.statistics.reader import read_statistics
from shmmap.statistics.writer import StatisticsWriter
from tests.unit.statistics.conftest import client, row


def test_no_room_for_clients(shm: ShmDirectory, writer: StatisticsWriter) -> None:
    writer._reserve = lambda _: False
    writer.show_clients([client(number) for number in range(20)])
    writer.beat()
    assert len(read_statistics("unit", shm.path).clients) == 16


@pytest.mark.parametrize("cause", ["file system", "budget"])
def test_no_room_for_rows(
    shm: ShmDirectory, writer: StatisticsWriter, monkeypatch: pytest.MonkeyPatch, cause: str
) -> None:
    """The first 256 rows are there from the start; the next five find no room at first."""
    fallocate = os.posix_fallocate
    full = True

    def refuse(fd: int, offset: int, length: int) -> None:
        if full:
            raise OSError(28, "No space left on device")
        fallocate(fd, offset, length)

    if cause == "budget":
        writer._reserve = lambda _: not full
    else:
        monkeypatch.setattr(os, "posix_fallocate", refuse)
    size = writer.size_bytes
    for number in range(261):
        writer.cell_changed(number, row(number))
    writer.add("requests")
    writer.beat(max_rows=1000)
    seen = read_statistics("unit", shm.path)
    assert (len(seen.cells), seen.rows_missing, seen.counters["requests"]) == (256, 5, 1)
    assert writer.size_bytes == size
    writer.cell_removed(256)
    writer.cell_changed(257, row(257, nbytes=8192))
    writer.cell_changed(3, row(3, nbytes=8192))
    writer.beat()
    seen = read_statistics("unit", shm.path)
    assert (seen.rows_missing, seen.cells[3].bytes) == (4, 8192)
    writer.cell_removed(0)
    writer.beat()
    assert read_statistics("unit", shm.path).rows_missing == 3  # took the row that became free
    full = False
    writer.beat()
    seen = read_statistics("unit", shm.path)
    assert (seen.rows_missing, [c.version for c in seen.cells]) == (0, [*range(1, 256), 257, 258, 259, 260])
    assert seen.cells[255].bytes == 8192


@contextlib.contextmanager
def files_no_larger_than(nbytes: int) -> Iterator[None]:
    """Let writes beyond ``nbytes`` of any file fail (EFBIG; Python ignores SIGXFSZ)."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (nbytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_what_cannot_be_written_is_written_as_soon_as_it_can(
    shm: ShmDirectory, writer: StatisticsWriter, identity: DaemonIdentity, caplog: pytest.LogCaptureFixture
) -> None:
    """Wherever the limit lies, also in the midst of a block; what was whole stays readable throughout."""
    layout = plan(COUNTERS, HISTOGRAMS)
    limits = [
        0,
        layout.identity_offset + 100,
        layout.state_offset + 100,
        layout.state_offset + layout.state_bytes + 100,
        layout.table_offset,
        layout.clients_offset + CLIENT_ROW_BYTES + 20,
        layout.rows_offset,
        layout.rows_offset + 3 * CELL_ROW_BYTES + 20,
    ]
    writer.show_clients([client(0)])
    for number in range(3):
        writer.cell_changed(number, row(number))
    writer.beat()
    for turn, limit in enumerate(limits, 1):
        new = 10 * turn
        with files_no_larger_than(limit):
            for version in (turn - 1, turn):
                writer.update_identity(replace(identity, map_version=100 + version))
            writer.show_clients([client(turn), client(turn + 1)])
            writer.cell_removed(0 if turn == 1 else new - 10)
            writer.cell_changed(1, row(1, nbytes=4096 * turn))
            for key in (new, new + 1):
                writer.cell_changed(key, row(key))
            writer.cell_removed(new + 1)
            writer.add("requests")
            for _ in range(3):
                writer.beat()
            assert read_statistics("unit", shm.path).state == "healthy"
        writer.show_clients([client(turn), client(turn + 1)])
        writer.beat()
        seen = read_statistics("unit", shm.path)
        assert seen.identity == replace(identity, map_version=100 + turn)
        assert seen.clients == [client(turn), client(turn + 1)]
        assert [cell.version for cell in seen.cells] == [1, 2, new]
        assert seen.cells[0].bytes == 4096 * turn
        assert (seen.rows_missing, seen.counters["requests"]) == (0, turn)
        assert not writer.outdated
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "File too large" in caplog.text


def test_a_successor_s_are_never_taken_away(shm: ShmDirectory, identity: DaemonIdentity) -> None:
    old = StatisticsWriter(shm, "unit", identity)
    old.add("requests", 1)
    os.unlink(f"{shm.path}/shmmap.unit.statistics")  # else there could be none
    new = StatisticsWriter(shm, "unit", replace(identity, epoch=2))
    old.beat()
    seen = read_statistics("unit", shm.path)
    assert seen.identity is not None
    assert (seen.identity.epoch, seen.counters["requests"]) == (2, 0)
    old.close()
    assert read_statistics("unit", shm.path).state == "healthy"
    new.close()
    assert read_statistics("unit", shm.path).state == "absent"
    assert os.listdir(shm.path) == []


def test_too_long_an_identity_is_refused(shm: ShmDirectory, identity: DaemonIdentity) -> None:
    with pytest.raises(ValueError, match="does not fit"):
        StatisticsWriter(shm, "unit", replace(identity, map_path="/" + "x" * 20000))
    assert os.listdir(shm.path) == []


def test_a_name_that_another_file_has(shm: ShmDirectory, identity: DaemonIdentity) -> None:
    """A directory stands for another account's file: it cannot be replaced either."""
    path = f"{shm.path}/shmmap.unit.statistics"
    os.mkdir(path)
    with pytest.raises(CannotStart) as failure:
        StatisticsWriter(shm, "unit", identity)
    user = pwd.getpwuid(os.geteuid()).pw_name
    assert failure.value.message == (
        f"the statistics cannot be {path}: there is a directory of user {user} (uid {os.geteuid()})"
        " (Is a directory)"
    )
    assert f"`sudo rm -r {path}`" in failure.value.hint
    assert os.listdir(shm.path) == ["shmmap.unit.statistics"]
    os.rmdir(path)

# SPDX-License-Identifier: Apache-2.0
"""What the writer writes, the reader reads: also meanwhile, in halves, and when there is no room."""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from shmmap.errors import ConfigError, NotPermitted, SegmentCorrupt
from shmmap.segment.directory import ShmDirectory
from shmmap.statistics import identity as identity_module
from shmmap.statistics.cell_rows import CELL_ROW_BYTES, CellRow
from shmmap.statistics.client_rows import CLIENT_ROW_BYTES, ClientRow
from shmmap.statistics.counters import COUNTERS, HISTOGRAMS
from shmmap.statistics.histogram import bucket_of
from shmmap.statistics.identity import DaemonIdentity, WriterProcess, judge, pid_namespace, start_time_ticks
from shmmap.statistics.layout import plan
from shmmap.statistics.reader import StatisticsReader, read_statistics
from shmmap.statistics.writer import StatisticsWriter

BOX = (0.0, 0.0, 20.0, 20.0)


def row(number: int, *, nbytes: int = 4096) -> CellRow:
    return CellRow(f"{number:04d}.pcd", "points", number, f"{number:016x}", "resident", nbytes, 10, BOX)


@pytest.fixture
def identity(shm: ShmDirectory) -> DaemonIdentity:
    return DaemonIdentity(
        pid=os.getpid(),
        start_time_ticks=start_time_ticks(os.getpid()),
        pid_namespace=pid_namespace(),
        epoch=2**64 - 1,
        instance="unit",
        endpoint="/run/ä b\n.sock",
        map_path="/maps/city",
        map_version=7,
        shm_dir=shm.path,
        id_prefix="/maps/city/pointcloud_map.pcd/",
        library_version="1.2.3",
        started_unix_ns=5,
    )


@pytest.fixture
def writer(shm: ShmDirectory, identity: DaemonIdentity) -> Iterator[StatisticsWriter]:
    one = StatisticsWriter(shm, "unit", identity)
    yield one
    one.close()
    assert os.listdir(shm.path) == []


def test_everything_comes_back(shm: ShmDirectory, writer: StatisticsWriter, identity: DaemonIdentity) -> None:
    writer.add("requests", 3)
    writer.set("budget_bytes", 2**62)
    writer.values["hits"] += 5
    writer.cell_changed("b", row(2))
    writer.cell_changed("a", row(1))
    writer.beat()
    seen = read_statistics("unit", shm.path)
    assert seen.state == "healthy"
    assert seen.identity == identity
    assert seen.counters == {c.name: 0 for c in COUNTERS} | {"requests": 3, "budget_bytes": 2**62, "hits": 5}
    assert seen.descriptions == COUNTERS
    assert seen.cells == [row(1), row(2)]
    assert seen.rows_missing == 0
    assert seen.size_bytes == writer.size_bytes


def test_rows_change_move_and_go(shm: ShmDirectory, writer: StatisticsWriter) -> None:
    for number in range(600):
        writer.cell_changed(number, row(number))
    writer.beat(max_rows=1000)
    for number in range(0, 600, 2):
        writer.cell_removed(number)
    writer.cell_removed("never seen")
    writer.cell_changed(1, row(1, nbytes=8192))
    writer.cell_changed(9999, row(9999))
    writer.cell_changed(5, row(5))
    writer.cell_removed(5)
    writer.beat(max_rows=1000)
    cells = read_statistics("unit", shm.path).cells
    assert [c.version for c in cells] == [n for n in range(1, 600, 2) if n != 5] + [9999]
    assert cells[0].bytes == 8192
    size = writer.size_bytes
    for number in range(1000, 1250):
        writer.cell_changed(number, row(number))
    writer.beat(max_rows=1000)
    assert writer.size_bytes == size  # the rows that were freed are used again
    assert len(read_statistics("unit", shm.path).cells) == 300 - 1 + 1 + 250


def test_durations_come_back(shm: ShmDirectory, writer: StatisticsWriter) -> None:
    for duration in (0, 1500, 2_000_000, 2_100_000, 10**15):
        writer.add_duration("load", duration)
    writer.beat()
    seen = read_statistics("unit", shm.path)
    assert seen.histogram_descriptions == HISTOGRAMS
    load = seen.histograms["load"]
    assert (load.total, load.sum_ns) == (5, 10**15 + 4_101_500)
    for duration in (0, 1500, 2_100_000, 10**15):
        assert load.counts[bucket_of(duration)] > 0
    assert seen.histograms["request"].total == 0


def client(number: int) -> ClientRow:
    return ClientRow(number + 1, 100 + number, 0, number, 0, 0, 0, f"client {number}", "python3")


def test_clients_come_and_go(shm: ShmDirectory, writer: StatisticsWriter) -> None:
    for count in (0, 3, 40, 2, 300):
        writer.show_clients([client(number) for number in range(count)])
        writer.beat()
        assert read_statistics("unit", shm.path).clients == [client(n) for n in range(min(count, 256))]
    changed = [client(number)._replace(requests=7) for number in range(2)]
    writer.show_clients(changed)
    writer.beat()
    assert read_statistics("unit", shm.path).clients == changed


def test_no_room_for_clients(shm: ShmDirectory, writer: StatisticsWriter) -> None:
    writer.reserve = lambda _: False
    writer.show_clients([client(number) for number in range(20)])
    writer.beat()
    assert len(read_statistics("unit", shm.path).clients) == 16


def test_one_reader_follows_lives_of_the_daemon(shm: ShmDirectory, identity: DaemonIdentity) -> None:
    with StatisticsReader("unit", shm.path) as reader:
        assert reader.snapshot().state == "absent"
        first = StatisticsWriter(shm, "unit", identity)
        assert reader.snapshot().identity == identity
        first.add("requests", 5)
        first.update_identity(replace(identity, map_version=8))
        first.beat()
        seen = reader.snapshot(tables=False)
        assert seen.identity is not None
        assert (seen.counters["requests"], seen.identity.map_version) == (5, 8)
        second = StatisticsWriter(shm, "unit", replace(identity, epoch=9))
        seen = reader.snapshot()
        assert seen.identity is not None
        assert (seen.counters["requests"], seen.identity.epoch) == (0, 9)
        first.close()
        second.close()
        assert reader.snapshot().state == "absent"


def test_a_beat_writes_a_bounded_number_of_rows(shm: ShmDirectory, writer: StatisticsWriter) -> None:
    for number in range(10):
        writer.cell_changed(number, row(number))
    seen = []
    for _ in range(4):
        writer.beat(max_rows=4)
        seen.append(len(read_statistics("unit", shm.path).cells))
    assert seen == [4, 8, 10, 10]


def test_a_new_identity(shm: ShmDirectory, writer: StatisticsWriter, identity: DaemonIdentity) -> None:
    for version in range(8, 12):
        writer.update_identity(replace(identity, map_version=version))
        seen = read_statistics("unit", shm.path).identity
        assert seen is not None
        assert seen.map_version == version


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
        writer.reserve = lambda _: not full
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
    """Let writes behind so many bytes of any file fail (EFBIG; Python ignores SIGXFSZ)."""
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
        layout.clients_offset + CLIENT_ROW_BYTES + 100,
        layout.rows_offset,
        layout.rows_offset + 3 * CELL_ROW_BYTES + 100,
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


def test_a_leftover_is_replaced_and_never_taken_away(shm: ShmDirectory, identity: DaemonIdentity) -> None:
    old = StatisticsWriter(shm, "unit", identity)
    old.add("requests", 1)
    Path(shm.path, "shmmap.unit.statistics.next").touch()  # a predecessor that died in between
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


def test_a_removed_segment_is_no_error_at_the_end(shm: ShmDirectory, identity: DaemonIdentity) -> None:
    writer = StatisticsWriter(shm, "unit", identity)
    os.unlink(f"{shm.path}/shmmap.unit.statistics")
    writer.beat()
    writer.close()


@pytest.mark.parametrize(("mode", "group"), [(0o400, -1), (0o440, os.getgid())])
def test_mode(shm: ShmDirectory, identity: DaemonIdentity, mode: int, group: int) -> None:
    writer = StatisticsWriter(shm, "unit", identity, mode=mode, gid=group)
    status = os.stat(f"{shm.path}/shmmap.unit.statistics")
    assert (status.st_mode & 0o7777, status.st_gid) == (mode, os.getgid())
    writer.close()


def test_too_long_an_identity_is_refused(shm: ShmDirectory, identity: DaemonIdentity) -> None:
    with pytest.raises(ValueError, match="does not fit"):
        StatisticsWriter(shm, "unit", replace(identity, map_path="/" + "x" * 20000))
    assert os.listdir(shm.path) == []


@pytest.mark.parametrize("name", ["/shmmap.unit.statistics", "/shmmap.unit.statistics.next"])
def test_a_name_that_somebody_else_has(shm: ShmDirectory, identity: DaemonIdentity, name: str) -> None:
    """A directory stands for a stranger's file: it cannot be replaced either."""
    os.mkdir(shm.path + name)
    with pytest.raises(ConfigError, match="Is a directory"):
        StatisticsWriter(shm, "unit", identity)
    assert [f"/{left}" for left in os.listdir(shm.path)] == [name]
    os.rmdir(shm.path + name)


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


def test_absent(shm: ShmDirectory) -> None:
    seen = read_statistics("unit", shm.path)
    assert (seen.state, seen.identity, seen.counters, seen.cells) == ("absent", None, {}, [])


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


@pytest.mark.root
def test_a_stranger_may_not_read(shm: ShmDirectory, writer: StatisticsWriter) -> None:
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
    data[rows_at + 256 + 3] ^= 0xFF
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
                writer.cell_changed(key, replace(row(key), hits=count))
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


_SLEEPER = "import sys; print('up', flush=True); sys.stdin.read()"


def test_states_of_a_real_process(identity: DaemonIdentity) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", _SLEEPER], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        other = replace(identity, pid=process.pid, start_time_ticks=start_time_ticks(process.pid))
        watched = WriterProcess(other)
        assert watched.state(0.1) == "healthy"
        assert WriterProcess(replace(other, start_time_ticks=1)).state(0.1) == "dead"
        assert WriterProcess(replace(other, pid_namespace=1)).state(0.1) == "healthy"
        assert judge(other, 0.1) == "healthy"
        assert watched.state(identity_module.HUNG_AFTER_S + 1) == "hung"
        assert judge(other, identity_module.HUNG_AFTER_S + 1) == "hung"
        assert judge(replace(other, start_time_ticks=1), 0.1) == "dead"  # the id was used again
        process.send_signal(signal.SIGSTOP)
        os.waitpid(process.pid, os.WUNTRACED)
        assert judge(other, 0.1) == watched.state(0.1) == "stopped"
        elsewhere = replace(other, pid_namespace=1)
        assert judge(elsewhere, 0.1) == "healthy"  # its pid means nothing here: the beat decides
        assert judge(elsewhere, 100.0) == "hung"
        process.kill()
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        assert judge(other, 0.1) == watched.state(0.1) == "dead"  # not yet waited for: a zombie
        process.wait()
        assert judge(other, 0.1) == watched.state(0.1) == "dead"
        watched.close()


def test_reading_loads_neither_numpy_nor_anything_heavy() -> None:
    code = (
        "import sys, shmmap.statistics.reader\n"
        "print(sorted({'numpy', 'zmq', 'msgspec', 'rich', 'posix_ipc', 'xxhash'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=Path.cwd()
    )
    assert done.stdout.strip() == "[]"

# SPDX-License-Identifier: Apache-2.0
"""What the writer writes, the reader reads; how the daemon is, by its process and its beat."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from dataclasses import replace

import msgspec

from shmmap.segment.directory import ShmDirectory
from shmmap.statistics.counters import COUNTERS, HISTOGRAMS, bucket_of
from shmmap.statistics.identity import HUNG_AFTER_S, DaemonIdentity, WriterProcess, start_time_ticks
from shmmap.statistics.reader import StatisticsReader, read_statistics
from shmmap.statistics.writer import StatisticsWriter
from tests.unit.statistics.conftest import client, live_map, row


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


def test_clients_come_and_go(shm: ShmDirectory, writer: StatisticsWriter) -> None:
    for count in (0, 3, 40, 2, 300):
        writer.show_clients([client(number) for number in range(count)])
        writer.beat()
        assert read_statistics("unit", shm.path).clients == [client(n) for n in range(min(count, 256))]
    changed = [msgspec.structs.replace(client(number), requests=7) for number in range(2)]
    writer.show_clients(changed)
    writer.beat()
    assert read_statistics("unit", shm.path).clients == changed


def test_one_reader_follows_the_daemon_s_runs(shm: ShmDirectory, identity: DaemonIdentity) -> None:
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
        os.unlink(
            f"{shm.path}/shmmap.unit.statistics"
        )  # the first one still runs, so its name would be refused
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


def test_live_maps_take_memory_only_where_there_are_any(shm: ShmDirectory, writer: StatisticsWriter) -> None:
    assert read_statistics("unit", shm.path).live == []
    before = writer.size_bytes
    rows = [live_map(number) for number in range(9)]
    for _ in range(2):
        writer.show_live_maps(rows)
        assert read_statistics("unit", shm.path).live == rows
        assert writer.size_bytes == before + 3 * 4096
        rows[3] = msgspec.structs.replace(rows[3], problem="disk full", chunks=77)
    writer.show_live_maps([live_map(number) for number in range(65)])
    assert len(read_statistics("unit", shm.path).live) == 64


def test_live_maps_that_find_no_memory_are_shown_later(shm: ShmDirectory, writer: StatisticsWriter) -> None:
    row = live_map(1)
    writer._reserve = lambda _nbytes: False
    writer.show_live_maps([row])
    assert read_statistics("unit", shm.path).live == []
    writer._reserve = lambda _nbytes: True
    writer.show_live_maps([row])
    assert read_statistics("unit", shm.path).live == [row]


_SLEEPER = "import sys; print('up', flush=True); sys.stdin.read()"


def test_states_of_a_real_process(identity: DaemonIdentity) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", _SLEEPER], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        other = replace(identity, pid=process.pid, start_time_ticks=start_time_ticks(process.pid))
        elsewhere = WriterProcess(replace(other, pid_namespace=1))  # its pid means nothing here
        with contextlib.closing(WriterProcess(other)) as watched:
            assert (watched.state(0.1), watched.state(HUNG_AFTER_S + 1)) == ("healthy", "hung")
            assert (elsewhere.state(0.1), elsewhere.state(HUNG_AFTER_S + 1)) == ("healthy", "hung")
            with contextlib.closing(WriterProcess(replace(other, start_time_ticks=1))) as predecessor:
                assert predecessor.state(0.1) == "dead"  # the id was used again
            process.send_signal(signal.SIGSTOP)
            os.waitpid(process.pid, os.WUNTRACED)
            assert watched.state(0.1) == "stopped"
            process.kill()
            os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
            assert watched.state(0.1) == "dead"  # not yet waited for: a zombie
            process.wait()
            assert watched.state(0.1) == WriterProcess(other).state(0.1) == "dead"


def test_starting_until_it_listens(shm: ShmDirectory, identity: DaemonIdentity) -> None:
    with contextlib.closing(StatisticsWriter(shm, "unit", identity, starting=True)) as writer:
        assert read_statistics("unit", shm.path).state == "starting"
        writer.set("starting", 0)
        writer.beat()
        assert read_statistics("unit", shm.path).state == "healthy"

# SPDX-License-Identifier: Apache-2.0
"""What the writer writes, the reader reads; how the daemon is, by its process and its beat."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from dataclasses import replace

from shmmap.segment.directory import ShmDirectory
from shmmap.statistics.counters import COUNTERS, HISTOGRAMS, bucket_of
from shmmap.statistics.identity import HUNG_AFTER_S, DaemonIdentity, WriterProcess, start_time_ticks
from shmmap.statistics.reader import StatisticsReader, read_statistics
from shmmap.statistics.writer import StatisticsWriter


def test_everything_comes_back(shm: ShmDirectory, writer: StatisticsWriter, identity: DaemonIdentity) -> None:
    writer.add("requests", 3)
    writer.set("budget_bytes", 2**62)
    writer.values["hits"] += 5
    writer.beat()
    seen = read_statistics("unit", shm.path)
    assert seen.state == "healthy"
    assert seen.identity == identity
    assert seen.counters == {c.name: 0 for c in COUNTERS} | {"requests": 3, "budget_bytes": 2**62, "hits": 5}
    assert seen.descriptions == COUNTERS


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


def test_one_reader_follows_the_daemon_s_runs(shm: ShmDirectory, identity: DaemonIdentity) -> None:
    with contextlib.closing(StatisticsReader("unit", shm.path)) as reader:
        assert reader.snapshot().state == "absent"
        first = StatisticsWriter(shm, "unit", identity)
        assert reader.snapshot().identity == identity
        first.add("requests", 5)
        first.update_identity(replace(identity, map_version=8))
        first.beat()
        seen = reader.snapshot()
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
            assert watched.state(0.1) == "dead"  # not yet waited for: state Z
            process.wait()
            assert watched.state(0.1) == WriterProcess(other).state(0.1) == "dead"


def test_starting_until_it_listens(shm: ShmDirectory, identity: DaemonIdentity) -> None:
    with contextlib.closing(StatisticsWriter(shm, "unit", identity, starting=True)) as writer:
        assert read_statistics("unit", shm.path).state == "starting"
        writer.set("starting", 0)
        writer.beat()
        assert read_statistics("unit", shm.path).state == "healthy"

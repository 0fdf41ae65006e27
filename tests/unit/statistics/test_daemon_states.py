# SPDX-License-Identifier: Apache-2.0
"""How the daemon is, by what the kernel says of its process and by its beat."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from dataclasses import replace

from shmmap.segment.directory import ShmDirectory
from shmmap.statistics import identity as identity_module
from shmmap.statistics.identity import DaemonIdentity, WriterProcess, judge, start_time_ticks
from shmmap.statistics.reader import read_statistics
from shmmap.statistics.writer import StatisticsWriter

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


def test_starting_until_it_listens(shm: ShmDirectory, identity: DaemonIdentity) -> None:
    with contextlib.closing(StatisticsWriter(shm, "unit", identity, starting=True)) as writer:
        assert read_statistics("unit", shm.path).state == "starting"
        writer.set("starting", 0)
        writer.beat()
        assert read_statistics("unit", shm.path).state == "healthy"

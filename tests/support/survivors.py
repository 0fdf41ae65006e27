# SPDX-License-Identifier: Apache-2.0
"""Ends what a run of the tests started when that run itself was ended: by a faulthandler timeout, by SIGKILL.

Whatever a test starts carries the run's mark in its environment, and whatever it forks has the other end of a
pipe.  As a program: ``python -m tests.support.survivors MARK PIDFD`` waits until the process of PIDFD has
ended, and kills everything that carries MARK or has the other end of its input.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import select
import signal
import subprocess
import sys
from collections.abc import Iterator
from typing import Final

import pytest

from tests.support.daemon_process import ROOT, processes_marked, wait_ended
from tests.support.forked_programs import forking

_VARIABLE: Final = "PYTEST_RUN_OF_SHMMAP"  # what begins with SHMMAP_ is kept from many a program


@pytest.fixture(scope="session", autouse=True)
def no_survivors() -> Iterator[None]:
    """Mark what this run starts, and have it killed as soon as this process is gone."""
    mark = secrets.token_hex(8)
    pidfd = os.pidfd_open(os.getpid())
    watcher = subprocess.Popen(
        [sys.executable, "-m", "tests.support.survivors", mark, str(pidfd)],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        pass_fds=[pidfd],
        start_new_session=True,  # Ctrl-C is not for it
    )
    os.close(pidfd)
    with pytest.MonkeyPatch.context() as patch, forking():
        patch.setenv(_VARIABLE, mark)
        yield
    watcher.kill()
    watcher.communicate()


def main() -> None:
    """Wait for the end of the run, then kill what is left of it."""
    mark, pidfd = sys.argv[1], int(sys.argv[2])
    select.select([pidfd], [], [])
    while left := {*processes_marked(mark, _VARIABLE), *_forks()}:
        for pid in left:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
            wait_ended(pid)


def _forks() -> Iterator[int]:
    """Yield the ids of processes that have the other end of this one's input."""
    pipe = os.fstat(0)
    for process in os.listdir("/proc"):
        if process.isdigit() and int(process) != os.getpid():
            with contextlib.suppress(OSError):  # gone by now, or another account's
                if any(os.path.samestat(os.stat(entry), pipe) for entry in os.scandir(f"/proc/{process}/fd")):
                    yield int(process)


if __name__ == "__main__":
    main()

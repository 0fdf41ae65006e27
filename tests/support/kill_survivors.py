# SPDX-License-Identifier: Apache-2.0
"""``python -m tests.support.kill_survivors VARIABLE MARK PIDFD``: end what a run of the tests leaves.

It waits until the process of PIDFD has ended, and kills what has VARIABLE=MARK in its environment, or has
the other end of its input.  Each of pytest's processes starts one: so it imports little.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sys
from collections.abc import Iterator

from shmmap.testing.daemon_process import processes_marked, wait_ended


def main() -> None:
    """Wait for the end of the run, then kill what is left of it."""
    variable, mark, pidfd = sys.argv[1], sys.argv[2], int(sys.argv[3])
    select.select([pidfd], [], [])
    while left := {*processes_marked(mark, variable), *_forks()}:
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

# SPDX-License-Identifier: Apache-2.0
"""Make a process end together with its parent.

``python -m shmmap.processes.end_with_parent PARENT COMMAND...`` runs a command that receives SIGTERM when
process PARENT ends, for whatever reason.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from typing import Final

_PR_SET_PDEATHSIG: Final = 1


def die_with(parent: int, number: signal.Signals = signal.SIGKILL) -> None:
    """Let the kernel send this process a signal when its parent, process ``parent``, ends."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_PDEATHSIG, number, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG) failed")
    if os.getppid() != parent:
        os._exit(0)  # the parent ended before the signal was set up


def with_us() -> list[str]:
    """Return the words to put before a command that must not outlive this process."""
    return [sys.executable, "-m", "shmmap.processes.end_with_parent", str(os.getpid())]


if __name__ == "__main__":
    die_with(int(sys.argv[1]), signal.SIGTERM)
    os.execvp(sys.argv[2], sys.argv[2:])  # noqa: S606

# SPDX-License-Identifier: Apache-2.0
"""Starting a child: a process of its own, with a channel of packets to it."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator

from shmmap.processes.packets import MAX_PACKET_BYTES

__all__ = ["channel", "how_ended", "start_child"]


def channel() -> tuple[socket.socket, socket.socket]:
    """Return both ends of a channel, the parent's first, which takes the longest job there is."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, MAX_PACKET_BYTES)
    return ours, theirs


def start_child(
    module: str, *arguments: str, new_session: bool
) -> tuple[subprocess.Popen[bytes], socket.socket]:
    """Start ``python -m MODULE CHANNEL_FD PARENT_PID ARGUMENT...``; Ctrl-C is the parent's to handle.

    The child has SIGINT blocked from its first instruction on: else it could end in the middle of its
    imports, with a traceback at the user's terminal.

    Parameters
    ----------
    module
        It has the kernel end it with its parent, see `shmmap.processes.end_with_parent`.
    *arguments
        What else it is told.
    new_session
        Whether keys pressed at the parent's terminal are kept from it.

    Returns
    -------
    The process, and our end of the channel.
    """
    ours, theirs = channel()
    try:
        with theirs, _interrupts_blocked():
            # one worker, one core: Open3D would start a thread for each, and so would numpy's OpenBLAS, whose
            # threads spin for a while after they were started
            environment = {
                "OMP_NUM_THREADS": "1",
                **os.environ,
                "OPENBLAS_NUM_THREADS": "1",
                "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
            }
            process = subprocess.Popen(
                [sys.executable, "-m", module, str(theirs.fileno()), str(os.getpid()), *arguments],
                pass_fds=(theirs.fileno(),), stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                env=environment, start_new_session=new_session,
                cwd="/",  # nothing is imported from where the parent happens to run
            )  # fmt: skip
    except BaseException:
        ours.close()
        raise
    return process, ours


@contextlib.contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Block SIGINT in this thread and in what it starts; one that came meanwhile is delivered afterwards."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def how_ended(code: int) -> str:
    """What a process's exit code says, for people."""
    if code >= 0:
        return f"exit code {code}"
    try:
        return f"signal {signal.Signals(-code).name}"
    except ValueError:  # those between SIGRTMIN and SIGRTMAX have no names
        return f"signal {-code}"

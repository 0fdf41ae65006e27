# SPDX-License-Identifier: Apache-2.0
"""Starting a child: a process of its own or a fork of this one, with a channel of packets to it.

Packets are received into one buffer that is there already: `socket.recv_fds` makes a new one of the largest
packet's size for each, half a mebibyte that the kernel maps, and unmaps again.
"""

from __future__ import annotations

import array
import contextlib
import os
import resource
import select
import signal
import socket
import subprocess
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from typing import Final, NoReturn

from shmmap.processes.end_with_parent import die_with

__all__ = [
    "MAX_PACKET_BYTES",
    "ForkedProcess",
    "channel",
    "channel_to_parent",
    "fork_child",
    "how_ended",
    "packet_buffer",
    "receive_packet",
    "start_child",
]

MAX_PACKET_BYTES: Final = 1 << 19
"""A job may name its cell and 65 neighbours by paths of 4095 bytes each."""

_ONE_DESCRIPTOR: Final = socket.CMSG_LEN(array.array("i").itemsize)


def channel() -> tuple[socket.socket, socket.socket]:
    """Return both ends of a channel, the parent's first; each takes the longest packet there is."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    for end in (ours, theirs):
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, MAX_PACKET_BYTES)
    return ours, theirs


def packet_buffer() -> bytearray:
    """Return a buffer that takes the largest packet; what was never written to costs no memory."""
    return bytearray(MAX_PACKET_BYTES)


def receive_packet(channel: socket.socket, buffer: bytearray, *, wait: bool = True) -> tuple[memoryview, int]:
    """Receive one packet, and the descriptor that came with it.

    Parameters
    ----------
    wait
        False: `BlockingIOError` where there is none, whatever else the channel waits for.

    Returns
    -------
    data
        The packet, valid until the next one is received into ``buffer``; empty when the other end is closed.
    fd
        The descriptor, closed on exec; -1 for none.

    Raises
    ------
    OSError
        As `socket.socket.recvmsg`.
    """
    flags = socket.MSG_CMSG_CLOEXEC if wait else socket.MSG_CMSG_CLOEXEC | socket.MSG_DONTWAIT
    count, control, _flags, _address = channel.recvmsg_into([buffer], _ONE_DESCRIPTOR, flags)
    fd = -1
    for level, kind, data in control:
        if (level, kind) == (socket.SOL_SOCKET, socket.SCM_RIGHTS) and len(data) >= 4:
            (fd,) = array.array("i", data[:4])
    return memoryview(buffer)[:count], fd


def start_child(
    module: str, *arguments: str, new_session: bool
) -> tuple[subprocess.Popen[bytes], socket.socket]:
    """Start ``python -m MODULE CHANNEL_FD PARENT_PID ARGUMENT...``; Ctrl-C is the parent's to handle.

    The child has SIGINT blocked from its first instruction on: else it could end in the middle of its
    imports, with a traceback at the user's terminal.

    Parameters
    ----------
    module
        It begins with `channel_to_parent`.
    *arguments
        Further arguments.
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
                pass_fds=(theirs.fileno(),),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                env=environment,
                start_new_session=new_session,
                cwd="/",  # nothing is imported from where the parent happens to run
            )
    except BaseException:
        ours.close()
        raise
    return process, ours


def channel_to_parent(arguments: Sequence[str]) -> socket.socket:
    """Begin a child that `start_child` has started: return its end of the channel.

    The kernel ends the child with its parent, and Ctrl-C is the parent's to handle.

    Parameters
    ----------
    arguments
        Those of the child's program, which begin with ``CHANNEL_FD PARENT_PID``.
    """
    die_with(int(arguments[1]))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    return socket.socket(fileno=int(arguments[0]))


class ForkedProcess:
    """A child made by `fork_child`, with what is used of `subprocess.Popen`."""

    def __init__(self, pid: int) -> None:
        self.pid = pid

    def kill(self) -> None:
        """Kill it."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGKILL)

    def wait(self, timeout: float) -> int:
        """Return its exit code; `subprocess.TimeoutExpired` if it has not ended in time."""
        pidfd = os.pidfd_open(self.pid)
        try:
            if not select.select([pidfd], [], [], timeout)[0]:
                raise subprocess.TimeoutExpired(str(self.pid), timeout)
        finally:
            os.close(pidfd)
        return os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])


def fork_child(main: Callable[[int, int], int]) -> tuple[ForkedProcess, socket.socket] | None:
    """Start a child that has imported already what this process has, in a session of its own.

    Parameters
    ----------
    main
        Called in the child with the descriptor of its end of the channel and this process's id; returns
        the exit code.

    Returns
    -------
    The process and our end of the channel; None where this process has other threads, which may hold locks
    that the child would wait for.

    Raises
    ------
    OSError
        No more processes or descriptors just now.
    """
    if len(os.listdir("/proc/self/task")) > 1:
        return None
    parent = os.getpid()
    ours, theirs = channel()
    with theirs, _interrupts_blocked():
        try:
            pid = os.fork()
        except OSError:
            ours.close()
            raise
        if not pid:
            _become(main, theirs.detach(), parent)
    return ForkedProcess(pid), ours


def _become(main: Callable[[int, int], int], fd: int, parent: int) -> NoReturn:
    """Run as the child: of what the parent has open only standard error is left."""
    code = 1
    try:
        os.environ.setdefault("OMP_NUM_THREADS", "1")
        nothing = os.open(os.devnull, os.O_RDWR)
        for standard in (0, 1):
            os.dup2(nothing, standard)
        os.closerange(3, fd)
        os.closerange(fd + 1, resource.getrlimit(resource.RLIMIT_NOFILE)[0])
        os.setsid()
        os.chdir("/")
        code = main(fd, parent)
    except BaseException:  # noqa: BLE001  nothing of the parent's may run in here any more
        traceback.print_exc()
    finally:
        os._exit(code)


@contextlib.contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Block SIGINT in this thread and in what it starts; one that came meanwhile is delivered afterwards."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def how_ended(code: int) -> str:
    """Describe a process's exit code for people."""
    if code >= 0:
        return f"exit code {code}"
    try:
        return f"signal {signal.Signals(-code).name}"
    except ValueError:  # those between SIGRTMIN and SIGRTMAX have no names
        return f"signal {-code}"

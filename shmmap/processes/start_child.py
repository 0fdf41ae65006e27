# SPDX-License-Identifier: Apache-2.0
"""Start a child, as a new process or a fork of this one, with a packet channel to it.

Packets are received into one preallocated buffer.  `socket.recv_fds` would allocate one of the largest
packet's size for each packet: half a mebibyte that the kernel maps and unmaps.
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

from shmmap import installed
from shmmap.processes.end_with_parent import die_with

MAX_PACKET_BYTES: Final = 1 << 19
"""Largest packet: a job may name its cell and 65 neighbours by paths of 4095 bytes each."""

_PACKAGE: Final = "SHMMAP_STARTED_BY"
"""Variable with `shmmap.installed.mark` of the process that started a child."""
_OTHER_VERSION: Final = 69  # EX_UNAVAILABLE of sysexits.h

_ONE_DESCRIPTOR: Final = socket.CMSG_LEN(array.array("i").itemsize)


def channel() -> tuple[socket.socket, socket.socket]:
    """Return both ends of a channel, the parent's first; each accepts packets of `MAX_PACKET_BYTES`."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    for end in (ours, theirs):
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, MAX_PACKET_BYTES)
    return ours, theirs


def packet_buffer() -> bytearray:
    """Return a buffer for the largest packet; pages that are never written cost no memory."""
    return bytearray(MAX_PACKET_BYTES)


def receive_packet(channel: socket.socket, buffer: bytearray, *, wait: bool = True) -> tuple[memoryview, int]:
    """Receive one packet, and the descriptor sent with it.

    Parameters
    ----------
    wait
        False: raise `BlockingIOError` if there is no packet, even if the channel is blocking.

    Returns
    -------
    data
        The packet, valid until the next one is received into ``buffer``; empty if the other end is closed.
    fd
        The descriptor, close-on-exec; -1 for none.

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
    """Start ``python -m MODULE CHANNEL_FD PARENT_PID ARGUMENT...``; the parent handles Ctrl-C.

    The child has SIGINT blocked from its first instruction on.  Otherwise it could end during its imports,
    with a traceback in the user's terminal.

    Parameters
    ----------
    module
        Module to run, which calls `channel_to_parent` first.
    *arguments
        Further arguments.
    new_session
        Whether to shield the child from signals of the parent's terminal.

    Returns
    -------
    The process, and the parent's end of the channel.

    Raises
    ------
    Replaced
        The package was replaced, so that the child would be of another version.
    OSError
        No more processes, memory or descriptors are available at present.
    """
    installed.refuse_if_replaced(module)
    ours, theirs = channel()
    try:
        with theirs, _interrupts_blocked():
            # one worker, one core: Open3D would start a thread for each, and so would numpy's OpenBLAS, whose
            # threads spin for a while after they were started
            environment = {
                "OMP_NUM_THREADS": "1",
                **os.environ,
                "OPENBLAS_NUM_THREADS": "1",
                _PACKAGE: installed.mark,
                "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
            }
            process = subprocess.Popen(
                [sys.executable, "-m", module, str(theirs.fileno()), str(os.getpid()), *arguments],
                pass_fds=(theirs.fileno(),),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                env=environment,
                start_new_session=new_session,
                cwd="/",  # nothing is imported from the parent's working directory
            )
    except BaseException:
        ours.close()
        raise
    return process, ours


def channel_to_parent(arguments: Sequence[str]) -> socket.socket:
    """Initialize a child of `start_child`, and return its end of the channel.

    The kernel kills the child when its parent ends, and the parent handles Ctrl-C.  A child of another
    version than its parent ends here: it might misunderstand the parent.

    Parameters
    ----------
    arguments
        Arguments of the child's program, which begin with ``CHANNEL_FD PARENT_PID``.
    """
    die_with(int(arguments[1]))
    if os.environ.pop(_PACKAGE, installed.mark) != installed.mark:
        raise SystemExit(_OTHER_VERSION)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    return socket.socket(fileno=int(arguments[0]))


class ForkedProcess:
    """A child of `fork_child`, with the needed part of `subprocess.Popen`'s interface."""

    def __init__(self, pid: int) -> None:
        self.pid = pid

    def kill(self) -> None:
        """Kill the process."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGKILL)

    def wait(self, timeout: float) -> int:
        """Return the process's exit code; raise `subprocess.TimeoutExpired` if it does not end in time."""
        pidfd = os.pidfd_open(self.pid)
        try:
            if not select.select([pidfd], [], [], timeout)[0]:
                raise subprocess.TimeoutExpired(str(self.pid), timeout)
        finally:
            os.close(pidfd)
        return os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])


def fork_child(main: Callable[[int, int], int]) -> tuple[ForkedProcess, socket.socket] | None:
    """Fork a child, which has this process's modules already, into a new session.

    Parameters
    ----------
    main
        Called in the child with the descriptor of its end of the channel and this process's id; returns
        the exit code.

    Returns
    -------
    The process and the parent's end of the channel; None if this process has other threads, which may hold
    locks that the child would wait for.

    Raises
    ------
    OSError
        No more processes or descriptors are available at present.
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
    """Run as the child; of the parent's descriptors only standard error and ``fd`` stay open."""
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
    except BaseException:  # noqa: BLE001  no code of the parent may run in the child
        traceback.print_exc()
    finally:
        os._exit(code)


@contextlib.contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Block SIGINT in this thread and its children; a SIGINT during the block is delivered afterwards."""
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

# SPDX-License-Identifier: Apache-2.0
"""The process that loaders are forked from: its imports are done, so a loader starts within milliseconds.

It has a single thread, opens no map file and no segment, and only forks.  A packet with one end of a channel
starts a loader.  When that loader has ended, the parent reports how over the same end
(`worker_messages.Ended`), after everything that the loader itself has sent.  The parent is killed with the
daemon, and the loaders with the parent.

Another child compiles the kernels of layers before a layer is requested: once per machine, for some seconds,
at the lowest priority.  If that child dies or lacks memory, each loader compiles the kernels it needs.
"""

from __future__ import annotations

import contextlib
import gc
import os
import select
import signal
import socket
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Final, NoReturn

from shmmap.compile_notices import log_first, watch
from shmmap.daemon.host.scheduling import take_slices
from shmmap.daemon.loading import worker_messages
from shmmap.daemon.loading.worker_main import WorkerSettings, limit_memory, work
from shmmap.kernel_cache import compiled_mark
from shmmap.processes.end_with_parent import die_with
from shmmap.processes.start_child import channel_to_parent, receive_packet
from shmmap.version import __version__

MAX_SETTINGS_BYTES: Final = 1 << 14
_OOM_SCORE: Final = b"500"  # if memory runs out, the kernel should kill a loader, not the daemon
_MAX_NICE: Final = 19


def _run_child(parent: int, run: Callable[[], int]) -> NoReturn:
    """Run a function in the child just forked, in a scheduling group of its own, and exit."""
    code = 1
    try:
        die_with(parent)
        os.setsid()  # see autogroups in sched(7)
        code = run()
    except BaseException:  # noqa: BLE001  none of the parent's code may run in the child
        traceback.print_exc()
    finally:
        os._exit(code)


def _compile() -> int:
    """Compile the kernels of layers, unless another daemon is doing so; return the exit code."""
    os.nice(_MAX_NICE)
    watch(log_first)
    from shmmap.layers.build import compile_kernels

    with contextlib.suppress(MemoryError):
        compile_kernels(wait=False)
    return 0


@dataclass(eq=False, slots=True)
class _Parent:
    """Forks loaders; ``_children`` maps pidfds to process ids and the parent's ends of loaders' channels."""

    channel: socket.socket
    settings: WorkerSettings
    _children: dict[int, tuple[int, socket.socket | None]] = field(default_factory=dict)
    _poller: select.poll = field(default_factory=select.poll)

    def run(self) -> None:
        """Fork until the daemon closes the channel."""
        self._poller.register(self.channel, select.POLLIN)
        mark = compiled_mark()
        if mark is not None and not mark.is_file():
            self._fork(_compile)
        buffer = bytearray(64)
        while True:
            for fd, _ in self._poller.poll():
                if fd in self._children:
                    self._reap(fd)
                    continue
                data, received = receive_packet(self.channel, buffer)
                if not data:
                    return
                if received >= 0:
                    end = socket.socket(fileno=received)
                    self._fork(partial(work, end, self.settings), end)

    def _fork(self, run: Callable[[], int], end: socket.socket | None = None) -> None:
        """Run a function in a child; ``end`` is its channel, if it is a loader."""
        ours = os.getpid()
        try:
            pid = os.fork()
        except OSError as error:
            _send_last(end, worker_messages.Ended(-1, f"fork: {error.strerror}"))
            return
        if not pid:
            self._become_child(ours, run)
        try:
            pidfd = os.pidfd_open(pid)
        except OSError as error:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
            _send_last(end, worker_messages.Ended(-1, f"pidfd_open: {error.strerror}"))
            return
        self._children[pidfd] = pid, end
        self._poller.register(pidfd, select.POLLIN)

    def _become_child(self, parent: int, run: Callable[[], int]) -> NoReturn:
        self.channel.close()
        for pidfd, (_, other) in self._children.items():
            os.close(pidfd)
            if other is not None:
                other.close()
        _run_child(parent, run)

    def _reap(self, pidfd: int) -> None:
        """Reap a child, and report how it ended if it was a loader."""
        self._poller.unregister(pidfd)
        os.close(pidfd)
        pid, end = self._children.pop(pidfd)
        _, status = os.waitpid(pid, 0)
        _send_last(end, worker_messages.Ended(os.waitstatus_to_exitcode(status)))


def _send_last(end: socket.socket | None, message: worker_messages.Ended) -> None:
    """Send a loader's last message and close its channel; if the channel is full, only close it."""
    if end is not None:
        with end, contextlib.suppress(OSError):
            end.send(worker_messages.encode(message), socket.MSG_DONTWAIT)


def main(arguments: list[str]) -> int:
    """Run with ``CHANNEL_FD PARENT_PID``.

    The first packet has the settings, separated by zero bytes: the directory of segments; a loader's memory
    limit, bytes; the disk cache's directory and size, or empty and 0; for a published map also the fields of
    `shmmap.origin.remote.opened_store.ServedFrom`.
    """
    ours = channel_to_parent(arguments)
    signal.signal(signal.SIGIO, signal.SIG_IGN)
    take_slices(0)  # short time slices are for processes that serve requests
    with contextlib.suppress(OSError), open("/proc/self/oom_score_adj", "wb") as score:
        score.write(_OOM_SCORE)
    with ours as channel, contextlib.suppress(ConnectionError):
        gc.collect()
        gc.freeze()  # a collection in a loader would copy the memory that all loaders share
        data, _ = receive_packet(channel, bytearray(MAX_SETTINGS_BYTES))
        if not data:
            return 0  # the daemon gave up starting
        shm_dir, memory_bytes, *more = map(os.fsdecode, bytes(data).split(b"\0"))
        limit_memory(int(memory_bytes))
        cache_dir, cache_bytes, *origin = more or ("", "0")
        settings = WorkerSettings(shm_dir, cache_dir, int(cache_bytes), tuple(origin))
        channel.send(__version__.encode())
        _Parent(channel, settings).run()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

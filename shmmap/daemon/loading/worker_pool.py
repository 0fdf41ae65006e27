# SPDX-License-Identifier: Apache-2.0
"""The pool of loader workers: started on demand, fed several jobs ahead, killed at a deadline."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import msgspec

from shmmap import __version__
from shmmap.daemon.loading import worker_messages
from shmmap.daemon.transport.watched_descriptors import WatchedDescriptors
from shmmap.logfmt import log
from shmmap.processes.packets import packet_buffer, receive_packet
from shmmap.processes.start_child import how_ended, start_child

__all__ = ["Worker", "WorkerPool"]

JOBS_AHEAD = 4
"""Jobs a worker is given beyond the one it works on, so that it never waits for the daemon's loop."""

END_PATIENCE_S = 0.1
"""How long the loop waits for a killed worker to end; one that hangs in the kernel may take for ever."""

START_DEADLINE_S = 60.0
"""How long a worker may take from its first job until it is ready: an interpreter and its imports."""


RESTART: Final = "shmmap was upgraded or removed while this daemon runs: restart the daemon"


def _installed() -> tuple[int, int] | None:
    """What tells the loader program on the disk from another one; None where there is none any more."""
    try:
        status = Path(__file__).with_name("worker_main.py").stat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns


@dataclass(eq=False, slots=True)
class Worker:
    """One worker process; ``queue`` holds its jobs, the first is the one it works on.

    ``foreign`` says that it is of another version of shmmap.
    """

    process: subprocess.Popen[bytes]
    channel: socket.socket
    queue: OrderedDict[int, worker_messages.Job | worker_messages.Check] = field(default_factory=OrderedDict)
    head_since_s: float = 0.0
    ready: bool = False
    foreign: bool = False

    @property
    def fd(self) -> int:
        """Descriptor to poll."""
        return self.channel.fileno()


@dataclass(eq=False, slots=True)
class WorkerPool:
    """Up to ``limit`` worker processes.

    Parameters
    ----------
    limit
        Most workers at a time.
    shm_dir
        Where they make segments.
    deadline_s
        How long one load may take; then its worker is killed.
    memory_bytes
        How much private memory each may use.
    cache_dir, cache_bytes
        Where finished layers are kept, and at most how much of them; empty or 0: nowhere.
    watched
        Told of the workers' descriptors.

    Attributes
    ----------
    on_message
        Called with a worker that has something to say.
    failed_starts
        Workers in a row that ended before they were ready: not their job's fault.
    """

    limit: int
    shm_dir: str
    deadline_s: float
    watched: WatchedDescriptors
    memory_bytes: int = 2 << 30
    cache_dir: str = ""
    cache_bytes: int = 0
    on_message: Callable[[Worker], None] = field(init=False)
    failed_starts: int = 0
    _workers: dict[int, Worker] = field(default_factory=dict)
    _ending: list[subprocess.Popen[bytes]] = field(default_factory=list)
    _program: tuple[int, int] | None = field(default_factory=_installed)
    _buffer: bytearray = field(default_factory=packet_buffer)

    def __len__(self) -> int:
        return len(self._workers)

    def __iter__(self) -> Iterator[Worker]:
        return iter(list(self._workers.values()))

    @property
    def has_room(self) -> bool:
        """Whether a job can be given to somebody.

        Workers that were killed and have not ended count: on a file system that hangs they would pile up.
        """
        self._ending = [process for process in self._ending if process.poll() is None]
        return self._may_start or any(len(worker.queue) <= JOBS_AHEAD for worker in self._workers.values())

    @property
    def _may_start(self) -> bool:
        return len(self._workers) + len(self._ending) < self.limit

    def start_one(self) -> Worker:
        """Start a worker process."""
        cache = (self.cache_dir, str(self.cache_bytes)) if self.cache_dir and self.cache_bytes else ()
        process, ours = start_child(
            "shmmap.daemon.loading.worker_main", self.shm_dir, str(self.memory_bytes), *cache,
            new_session=True,
        )  # fmt: skip
        ours.setblocking(False)
        worker = Worker(process, ours)
        self._workers[worker.fd] = worker
        self.watched.watch(worker.fd, lambda: self.on_message(worker), "loaders")
        return worker

    def submit(self, job: worker_messages.Job | worker_messages.Check, now_s: float) -> bool:
        """Give a job to the least busy worker, starting one if all are busy; False if nobody took it."""
        worker = min(self._workers.values(), key=lambda w: len(w.queue), default=None)
        if worker is None or (worker.queue and self._may_start):
            try:
                worker = self.start_one()
            except OSError as error:  # no more processes, memory or descriptors just now
                log.error("loader could not start", reason=error)
                if worker is None or len(worker.queue) > JOBS_AHEAD:
                    return False
        try:
            worker.channel.send(worker_messages.encode(job))
        except OSError:
            return False  # full or dying: its end is reported by its channel
        if not worker.queue:
            worker.head_since_s = now_s
        worker.queue[job.number] = job
        return True

    def answer(self, worker: Worker, message: worker_messages.Decision) -> None:
        """Answer a worker's `worker_messages.Need`."""
        with contextlib.suppress(OSError):
            worker.channel.send(worker_messages.encode(message))

    def receive(self, worker: Worker) -> tuple[worker_messages.FromWorker, int] | None:
        """Next message of a worker and the descriptor that came with it (-1: none).

        None when there is nothing more to read now.

        Raises
        ------
        EOFError
            When the worker is gone, or has lost its mind.
        """
        while True:
            try:
                data, fd = receive_packet(worker.channel, self._buffer)
                break
            except ConnectionResetError:
                continue  # told once, before what the dead worker had still said
            except BlockingIOError:
                return None
            except OSError as error:
                raise EOFError from error
        if not data:
            raise EOFError
        try:
            message = worker_messages.decode_from_worker(data)
        except msgspec.MsgspecError as error:
            log.error("loader ended", reason="its message cannot be read", error=error)
            if fd >= 0:
                os.close(fd)
            raise EOFError from error
        if isinstance(message, worker_messages.Ready) and message.version != __version__:
            worker.foreign = True
            raise EOFError
        return message, fd

    def finished(self, worker: Worker, number: int, now_s: float) -> None:
        """The worker is done with a job; its next one begins now."""
        worker.queue.pop(number, None)
        worker.head_since_s = now_s

    def remove(self, worker: Worker) -> tuple[list[worker_messages.Job | worker_messages.Check], str]:
        """Forget a dead worker; returns its unfinished jobs, and how it ended, for people."""
        self.watched.unwatch(worker.fd)
        self._workers.pop(worker.fd, None)
        worker.channel.close()
        worker.process.kill()
        try:
            how = how_ended(worker.process.wait(END_PATIENCE_S))
        except subprocess.TimeoutExpired:
            self._ending.append(worker.process)
            how = "killed, and has not ended yet"
        if not worker.ready and (worker.foreign or _installed() != self._program):
            how = RESTART
        return list(worker.queue.values()), how

    def overdue(self, now_s: float) -> list[Worker]:
        """Workers whose current load, or whose start, is past its deadline."""
        return [w for w in self._workers.values() if w.queue and now_s >= self._due_s(w)]

    def _due_s(self, worker: Worker) -> float:
        return worker.head_since_s + (self.deadline_s if worker.ready else START_DEADLINE_S)

    def next_deadline_s(self) -> float:
        """When the next load becomes overdue; infinity when nothing loads."""
        return min((self._due_s(w) for w in self._workers.values() if w.queue), default=float("inf"))

    def close(self) -> None:
        """End every worker."""
        for worker in self:
            self.remove(worker)

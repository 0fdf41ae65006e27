# SPDX-License-Identifier: Apache-2.0
"""The pool of loader workers: started on demand, given several jobs ahead, killed at a deadline.

Computed layers may take seconds each.  So a cell's points never wait behind them: they go to workers that
compute nothing, and while all compute one more is kept for points alone.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Final, TypeAlias

import msgspec

from shmmap.daemon.loading import worker_messages
from shmmap.daemon.loading.prepared_parent import PreparedParent
from shmmap.daemon.turns import WatchedDescriptors
from shmmap.layers.points import LAYER
from shmmap.logfmt import log
from shmmap.processes.start_child import channel, packet_buffer, receive_packet
from shmmap.segment.directory import ShmDirectory

__all__ = ["NOT_OPENED", "Opened", "Work", "Worker", "WorkerPool"]

Work = worker_messages.Job | worker_messages.Check
Opened: TypeAlias = tuple[str, int]
"""A directory that files are read through: its path, and a descriptor of it."""
NOT_OPENED: Final = ("", -1)

JOBS_AHEAD: Final = 4
"""Jobs a worker is given beyond the one it works on, so that it never waits for the daemon's loop."""

LAYERS_AHEAD: Final = 1
"""Computed layers among them: each may take long, and the next request waits for all that were given out."""

START_DEADLINE_S: Final = 60.0
"""How long a worker may take from its first job until it is ready: its parent's imports, and a fork."""


def _has_ended(pidfd: int) -> bool:
    poller = select.poll()
    poller.register(pidfd, select.POLLIN)
    return bool(poller.poll(0))


def is_computed(job: Work) -> bool:
    """Whether a job may take long; a look at a file or a segment does not."""
    return isinstance(job, worker_messages.Job) and job.layer != LAYER and not job.ready


@dataclass(eq=False, slots=True)
class Worker:
    """One worker process; ``queue`` holds its jobs.

    It works on the first of them, or, if it fetches for several jobs at once, on the one that it said it has
    ``begun``.

    Attributes
    ----------
    for_points
        It is the one more that computes nothing.
    layers
        How many of its jobs are layers to be computed.
    pid, pidfd
        Its process, from when it is ``ready``.
    segments
        Files without names that its jobs' segments go into, by job.
    prefetched
        Those of its jobs that no client waited for when they were given out.
    since_s
        When it began with its job; or when its last message came, if it only fetches.
    opened
        Directory that it reads files through.
    """

    channel: socket.socket
    for_points: bool = False
    layers: int = 0
    pid: int = 0
    pidfd: int = -1
    queue: OrderedDict[int, Work] = field(default_factory=OrderedDict)
    segments: dict[int, int] = field(default_factory=dict)
    prefetched: set[int] = field(default_factory=set)
    since_s: float = 0.0
    opened: Opened = NOT_OPENED
    fetches: bool = False
    begun: int = 0

    @property
    def fd(self) -> int:
        """Descriptor to poll."""
        return self.channel.fileno()

    @property
    def load(self) -> tuple[int, bool]:
        """How busy it is; a demand had better not come behind what is fetched ahead."""
        return len(self.queue) + len(self.prefetched), bool(self.prefetched)

    @property
    def ready(self) -> bool:
        """Whether it has begun: its death is its job's fault from then on."""
        return self.pid != 0

    @property
    def at_work(self) -> int:
        """Number of the job that it works on; 0 for none."""
        return self.begun if self.fetches else next(iter(self.queue), 0)


@dataclass(eq=False, slots=True)
class WorkerPool:
    """Up to ``limit`` worker processes, and one more for points while all of them compute.

    Parameters
    ----------
    limit
        Most workers at a time.
    directory
        Where segments are made.
    parent
        Makes them.
    deadline_s
        How long one load may take; then its worker is killed.
    watched
        Watches the workers' descriptors.
    on_message
        Called with a worker whose channel can be read.
    places
        Jobs that a worker can do at once: more than one where what they need has to be fetched.

    Attributes
    ----------
    failed_starts
        Workers in a row that ended before they were ready: not their job's fault.
    """

    limit: int
    directory: ShmDirectory
    parent: PreparedParent
    deadline_s: float
    watched: WatchedDescriptors
    on_message: Callable[[Worker], None]
    places: int = 1
    failed_starts: int = 0
    _workers: dict[int, Worker] = field(default_factory=dict)
    _ending: set[int] = field(default_factory=set)
    _buffer: bytearray = field(default_factory=packet_buffer)

    def __len__(self) -> int:
        return len(self._workers)

    def __iter__(self) -> Iterator[Worker]:
        return iter(list(self._workers.values()))

    # --- giving jobs ------------------------------------------------------------------------

    def has_room(self, *, computed: bool) -> bool:
        """Whether a worker could take a job: one that computes a layer, or another one."""
        found = self._least_busy(computed=computed) is not None
        return found or self._may_start or (not computed and self._may_start_one_for_points)

    @property
    def free_places(self) -> int:
        """How many jobs could be begun at once."""
        queues = [len(worker.queue) for worker in self._workers.values() if not worker.for_points]
        free = sum(max(0, self.places - jobs) for jobs in queues)
        return free + self.places * max(0, self.limit - len(queues) - len(self._ending))

    def _least_busy(self, *, computed: bool) -> Worker | None:
        """Return the worker for the next job of a kind; None if none has room for it."""
        able = [
            worker
            for worker in self._workers.values()
            if len(worker.queue) < self.places + JOBS_AHEAD
            and worker.layers <= LAYERS_AHEAD
            and not (worker.for_points if computed else worker.layers)
        ]
        return min(able, key=lambda worker: (worker.layers, worker.load), default=None)

    @property
    def _may_start(self) -> bool:
        """Whether there may be one more that does everything.

        Workers that were killed and have not ended count: on a file system that hangs they would pile up.
        """
        count = sum(not worker.for_points for worker in self._workers.values())
        return count + len(self._ending) < self.limit

    @property
    def _may_start_one_for_points(self) -> bool:
        """Whether all compute, so that there may be one more for what is not computed."""
        count = len(self._workers) + len(self._ending)
        return bool(self._workers) and count <= self.limit and all(w.layers for w in self)

    def start_one(self, *, for_points: bool = False) -> Worker:
        """Start a worker process; OSError if that cannot be done."""
        ours, theirs = channel()
        try:
            with theirs:
                self.parent.fork(theirs)
        except OSError:
            ours.close()
            raise
        ours.setblocking(False)
        worker = Worker(ours, for_points, fetches=self.places > 1)
        self._workers[worker.fd] = worker
        self.watched.watch(worker.fd, lambda: self.on_message(worker), "loaders")
        return worker

    def submit(self, job: Work, now_s: float, *, prefetch: bool = False, opened: Opened = NOT_OPENED) -> bool:
        """Give a job to the least busy worker, starting one if all are busy; False if none took it.

        Parameters
        ----------
        prefetch
            Whether no client waits for it.
        opened
            Directory that its files are to be read through: its path and a descriptor; -1 for none.

        Raises
        ------
        OSError
            No file can be made for its segment.
        """
        computed = is_computed(job)
        worker, start = self._least_busy(computed=computed), self._may_start
        if worker is None and not (start or (not computed and self._may_start_one_for_points)):
            return False
        if worker is None or (len(worker.queue) >= self.places and start):
            try:
                worker = self.start_one(for_points=not start)
            except OSError as error:  # no more processes, memory or descriptors just now
                log.error("loader could not start", reason=error)
                if worker is None:
                    return False
        if worker.ready and _has_ended(worker.pidfd):
            return False  # its parent is about to say so: the job would be taken for what it died of
        fd = -1 if isinstance(job, worker_messages.Check) else self.directory.create()
        try:
            self._send_root(worker, opened)
            self._send(worker, job, fd)
        except OSError:
            if fd >= 0:
                os.close(fd)
            return False  # full or dying: its end is reported by its channel
        if fd >= 0:
            worker.segments[job.number] = fd
        if not worker.queue:
            worker.since_s = now_s
        worker.queue[job.number] = job
        if prefetch:
            worker.prefetched.add(job.number)
        worker.layers += computed
        return True

    def read_through(self, opened: Opened) -> None:
        """Make all workers read what they are given from now on through another directory."""
        for worker in self._workers.values():
            worker.opened = ("unknown", -1)
            with contextlib.suppress(OSError):  # full or dying: with its next job, if there is one
                self._send_root(worker, opened)

    def _send_root(self, worker: Worker, opened: Opened) -> None:
        if opened != worker.opened:
            self._send(worker, worker_messages.Root(opened[0]), opened[1])
            worker.opened = opened

    def _send(self, worker: Worker, job: Work | worker_messages.Root, fd: int) -> None:
        """Send a job, and an empty file with one that makes a segment; or a directory."""
        packet = worker_messages.encode(job)
        if fd < 0:
            worker.channel.send(packet)
        else:
            socket.send_fds(worker.channel, [packet], [fd])

    def answer(self, worker: Worker, message: worker_messages.Decision) -> None:
        """Answer a worker's `worker_messages.Need`."""
        with contextlib.suppress(OSError):
            worker.channel.send(worker_messages.encode(message))

    # --- messages --------------------------------------------------------------------------

    def receive(self, worker: Worker) -> tuple[worker_messages.FromWorker, int] | None:
        """Return the next message of a worker and its descriptor (-1: none); None when there is none now.

        Raises
        ------
        EOFError
            When the worker's parent is gone, and it with it, or its message cannot be read.
        """
        while True:
            try:
                data, fd = receive_packet(worker.channel, self._buffer)
                break
            except ConnectionResetError:
                continue  # reported once, before what the dead worker had still sent
            except BlockingIOError:
                return None
            except OSError as error:
                raise EOFError from error
        if not data:
            raise EOFError
        try:
            return worker_messages.decode_from_worker(data), fd
        except msgspec.MsgspecError as error:
            log.error("loader ended", reason="its message cannot be read", error=error)
            if fd >= 0:
                os.close(fd)
            raise EOFError("its message could not be read") from error

    def begun(self, worker: Worker, pid: int, pidfd: int, now_s: float) -> None:
        """Note that a worker is ready; its pidfd is the pool's now."""
        worker.pid, worker.pidfd = pid, pidfd
        worker.since_s = now_s
        self.failed_starts = 0

    def works_on(self, worker: Worker, number: int, now_s: float) -> None:
        """Note that a worker that fetches has what a job needs, and works on it from now on."""
        worker.begun, worker.since_s = number, now_s

    def finished(self, worker: Worker, number: int, now_s: float) -> tuple[int, float]:
        """Note the end of a job; the worker's next one begins now, unless it fetches.

        Returns
        -------
        fd
            The file that its segment is in, the caller's to close; -1 for none.
        spent_s
            How long it worked on it, seconds.
        """
        began_s, at_work = worker.since_s, worker.at_work == number
        job = worker.queue.pop(number, None)
        worker.prefetched.discard(number)
        worker.layers -= job is not None and is_computed(job)
        if at_work:
            worker.begun = 0
        if at_work or not worker.at_work:
            worker.since_s = now_s
        return worker.segments.pop(number, -1), (now_s - began_s) * at_work

    # --- their end ------------------------------------------------------------------------------

    def remove(self, worker: Worker) -> list[Work]:
        """Forget a worker that is dead, or is to be; returns its unfinished jobs."""
        self.watched.unwatch(worker.fd)
        self._workers.pop(worker.fd, None)
        worker.channel.close()
        for fd in worker.segments.values():
            os.close(fd)
        worker.segments.clear()
        pidfd, worker.pidfd = worker.pidfd, -1
        if pidfd >= 0:
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(pidfd, signal.SIGKILL)
            if _has_ended(pidfd):
                os.close(pidfd)
            else:
                self._ending.add(pidfd)
                self.watched.watch(pidfd, lambda: self._reap(pidfd), "loaders")
        return list(worker.queue.values())

    def _reap(self, pidfd: int) -> None:
        self.watched.unwatch(pidfd)
        self._ending.discard(pidfd)
        os.close(pidfd)

    def overdue(self, now_s: float) -> list[Worker]:
        """Return workers whose load or start is past its deadline, or that fetch without a message."""
        return [w for w in self._workers.values() if w.queue and now_s >= self._due_s(w)]

    def _due_s(self, worker: Worker) -> float:
        return worker.since_s + (self.deadline_s if worker.ready else START_DEADLINE_S)

    def next_deadline_s(self) -> float:
        """Return when the next load becomes overdue; infinity when nothing loads."""
        return min((self._due_s(w) for w in self._workers.values() if w.queue), default=float("inf"))

    def close(self) -> None:
        """End every worker, and their parent."""
        for worker in self:
            self.remove(worker)
        self.parent.close()
        for pidfd in list(self._ending):
            self._reap(pidfd)

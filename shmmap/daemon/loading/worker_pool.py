# SPDX-License-Identifier: Apache-2.0
"""Pool of loader workers: started on demand, given several jobs in advance, killed at a deadline.

Computed layers may take seconds each.  So that a cell's points never wait for them, points are given to
workers that compute nothing, and while all workers compute, an extra worker is kept for points alone.
"""

from __future__ import annotations

import contextlib
import math
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
from shmmap.errors import Replaced
from shmmap.layers.points import LAYER
from shmmap.logfmt import log
from shmmap.processes.start_child import channel, how_ended, packet_buffer, receive_packet
from shmmap.segment.directory import ShmDirectory

Work = worker_messages.Job | worker_messages.Check | worker_messages.Prepare
Opened: TypeAlias = tuple[str, int]
"""Directory through which files are read: its path, and its descriptor."""
NOT_OPENED: Final = ("", -1)

STALLED_S: Final = 0.75
"""How long no job of a worker that fetches may get its data until the worker gets more places, seconds."""
JOBS_AHEAD: Final = 4
"""Jobs given to a worker beyond its current one, so that it never waits for the daemon's loop."""

LAYERS_AHEAD: Final = 1
"""Computed layers among these: each may take long, and a later request waits for all that were given out."""

START_DEADLINE_S: Final = 60.0
"""How long a worker may take from its first job until it is ready: the parent's imports and a fork."""


def _has_ended(pidfd: int) -> bool:
    poller = select.poll()
    poller.register(pidfd, select.POLLIN)
    return bool(poller.poll(0))


def is_computed(job: Work) -> bool:
    """Whether a load may take long; a check of a file or a segment does not."""
    return isinstance(job, worker_messages.Job) and job.layer != LAYER and not job.ready


@dataclass(eq=False, slots=True)
class Worker:
    """One worker process; ``queue`` contains its jobs.

    It works on the first job of the queue.  A worker that fetches for several jobs at a time works on the one
    that it reported as ``begun``.

    Attributes
    ----------
    for_points
        Whether it is the extra worker that computes nothing.
    layers
        Number of its jobs that compute layers.
    pid, pidfd
        Its process, once it is ``ready``.
    segments
        Unnamed files for its jobs' segments, by job.
    prefetched
        Its jobs that no client waited for when they were given out.
    since_s
        When it began its current job; while it only fetches, when its last message arrived.
    opened
        Directory through which it reads files.
    compiling
        Whether it compiles kernels for its present job.
    more_places
        Places beyond the usual ones, while all of those are taken by jobs whose data does not come.
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
    compiling: bool = False
    more_places: int = 0

    @property
    def fd(self) -> int:
        """File descriptor to poll."""
        return self.channel.fileno()

    @property
    def load(self) -> tuple[int, bool]:
        """How busy it is, as a sort key: a demand should not queue behind prefetched cells."""
        return len(self.queue) + len(self.prefetched), bool(self.prefetched)

    @property
    def ready(self) -> bool:
        """Whether the worker has started: its death is blamed on its job from then on."""
        return self.pid != 0

    @property
    def at_work(self) -> int:
        """Number of its current job; 0 for none."""
        return self.begun if self.fetches else next(iter(self.queue), 0)


@dataclass(eq=False, slots=True)
class WorkerPool:
    """Up to ``limit`` worker processes, and an extra one for points while all of them compute.

    Parameters
    ----------
    limit
        Most workers at a time.
    directory
        Directory in which segments are made.
    parent
        Forks the workers.
    deadline_s
        Time limit of one load; its worker is killed when it expires.
    watched
        Watches the workers' descriptors.
    on_message
        Called with a worker whose channel can be read.
    places
        Jobs that a worker can do at a time: more than one where their data has to be fetched.

    Attributes
    ----------
    failed_starts
        Consecutive workers that ended before they were ready, which is not their job's fault.
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
        """Whether a worker could take a job: one that computes a layer, or any other."""
        found = self._least_busy(computed=computed) is not None
        return found or self._may_start or (not computed and self._may_start_one_for_points)

    @property
    def is_ending(self) -> bool:
        """Whether workers that were killed have not exited yet: they keep their places."""
        return bool(self._ending)

    @property
    def compiling(self) -> int:
        """Number of workers that compile kernels now."""
        return sum(worker.compiling for worker in self._workers.values())

    @property
    def free_places(self) -> int:
        """Number of jobs that could begin at once."""
        queues = [
            len(worker.queue) - worker.more_places
            for worker in self._workers.values()
            if not worker.for_points
        ]
        free = sum(max(0, self.places - jobs) for jobs in queues)
        return free + self.places * max(0, self.limit - len(queues) - len(self._ending))

    def _least_busy(self, *, computed: bool) -> Worker | None:
        """Return the worker for the next job of a kind; None if no worker has room for it."""
        able = [
            worker
            for worker in self._workers.values()
            if len(worker.queue) < self.places + worker.more_places + JOBS_AHEAD
            and worker.layers <= LAYERS_AHEAD
            and not (worker.for_points if computed else worker.layers)
        ]
        return min(able, key=lambda worker: (worker.layers, worker.load), default=None)

    @property
    def _may_start(self) -> bool:
        """Whether another worker for all kinds of jobs may be started.

        Workers that were killed and have not exited count: on a file system that hangs they would pile up.
        """
        count = sum(not worker.for_points for worker in self._workers.values())
        return count + len(self._ending) < self.limit

    @property
    def _may_start_one_for_points(self) -> bool:
        """Whether all workers compute, so that an extra one for points may be started."""
        count = len(self._workers) + len(self._ending)
        return bool(self._workers) and count <= self.limit and all(w.layers for w in self)

    def start_one(self, *, for_points: bool = False) -> Worker:
        """Start a worker process; raise OSError if that fails, Replaced if it would be of another version."""
        ours, theirs = channel()
        try:
            with theirs:
                self.parent.fork(theirs)
        except (OSError, Replaced):
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
            Whether no client waits for the job.
        opened
            Directory through which its files are to be read: path and descriptor; -1 for none.

        Raises
        ------
        OSError
            The file for its segment cannot be created.
        Replaced
            There is no worker, and a new one would be of another version than this daemon.
        """
        computed = is_computed(job)
        worker, start = self._least_busy(computed=computed), self._may_start
        if worker is None and not (start or (not computed and self._may_start_one_for_points)):
            return False
        if worker is None or (len(worker.queue) >= self.places and start):
            try:
                worker = self.start_one(for_points=not start)
            except Replaced:
                if worker is None:
                    raise
            except OSError as error:  # not enough processes, memory or descriptors at present
                log.error("loader could not start", reason=error)
                if worker is None:
                    return False
        if worker.ready and _has_ended(worker.pidfd):
            return False  # its end is about to be reported: the job would be taken for the cause
        fd = self.directory.create() if isinstance(job, worker_messages.Job) else -1
        try:
            self._send_root(worker, opened)
            self._send(worker, job, fd)
        except OSError:
            if fd >= 0:
                os.close(fd)
            return False  # full or dying: its channel reports its end
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
        """Make all workers read through another directory from their next job on."""
        for worker in self._workers.values():
            worker.opened = ("unknown", -1)
            with contextlib.suppress(OSError):  # full or dying: sent with its next job, if there is one
                self._send_root(worker, opened)

    def _send_root(self, worker: Worker, opened: Opened) -> None:
        if opened != worker.opened:
            self._send(worker, worker_messages.Root(opened[0]), opened[1])
            worker.opened = opened

    def _send(self, worker: Worker, job: Work | worker_messages.Root, fd: int) -> None:
        """Send a job, with the empty file for its segment if it makes one; or a directory."""
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

    def messages(self, worker: Worker, clock: Callable[[], float]) -> Iterator[worker_messages.FromWorker]:
        """Yield a worker's messages that are here; raises as `next_message`."""
        while (message := self.next_message(worker, clock())) is not None:
            yield message

    def next_message(self, worker: Worker, now_s: float) -> worker_messages.FromWorker | None:
        """Return a worker's next message about its jobs; None if there is none now.

        Raises
        ------
        EOFError
            The worker has ended, or cannot be used; says why, if that is known.
        """
        while True:
            try:
                data, fd = receive_packet(worker.channel, self._buffer)
                break
            except ConnectionResetError:
                continue  # reported once, before the messages that the dead worker had sent
            except BlockingIOError:
                return None
            except OSError as error:
                raise EOFError from error
        if not data:
            raise EOFError  # its parent is gone, and the worker with it
        try:
            message = worker_messages.decode_from_worker(data)
        except msgspec.MsgspecError as error:
            log.error("loader ended", reason="its message cannot be read", error=error)
            if fd >= 0:
                os.close(fd)
            raise EOFError("its message could not be read") from error
        if isinstance(message, worker_messages.Ready) and fd >= 0:
            self.begun(worker, message.pid, fd, now_s)
            return None
        if fd >= 0:
            os.close(fd)
        if isinstance(message, worker_messages.Ended):
            raise EOFError(message.reason or how_ended(message.code))
        if isinstance(message, worker_messages.Ready):  # this process had no free descriptor for the pidfd
            raise EOFError("too many open files")
        return message

    def begun(self, worker: Worker, pid: int, pidfd: int, now_s: float) -> None:
        """Note that a worker is ready; the pool now owns its pidfd."""
        worker.pid, worker.pidfd = pid, pidfd
        worker.since_s = now_s
        self.failed_starts = 0

    def works_on(self, worker: Worker, number: int, now_s: float) -> None:
        """Note that a worker that fetches has a job's data, and works on that job from now on."""
        worker.begun, worker.since_s = number, now_s

    def finished(self, worker: Worker, number: int, now_s: float) -> tuple[int, float]:
        """Note the end of a job; the worker's next job begins now, unless the worker fetches.

        Returns
        -------
        fd
            The file that its segment is in, to be closed by the caller; -1 for none.
        spent_s
            How long the worker worked on the job, seconds.
        """
        began_s, at_work = worker.since_s, worker.at_work == number
        worker.compiling = False
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
        """Remove a worker that is dead, or about to be killed; return its unfinished jobs."""
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

    def make_places(self, now_s: float) -> None:
        """Give as many places again to workers that fetch and whose every place waits for data in vain.

        Otherwise a few objects that come slowly, or never, would hold up all others.
        """
        for worker in self._workers.values():
            if now_s >= self._stalled_s(worker):
                worker.more_places = self.places
            elif len(worker.queue) < self.places:
                worker.more_places = 0

    def _stalled_s(self, worker: Worker) -> float:
        """Return when a worker gets more places."""
        may_stall = worker.fetches and worker.ready and not worker.begun and not worker.more_places
        return worker.since_s + STALLED_S if may_stall and len(worker.queue) >= self.places else math.inf

    def overdue(self, now_s: float) -> list[Worker]:
        """Return workers whose load or start has passed its deadline, or that fetch without messages."""
        return [w for w in self._workers.values() if w.queue and now_s >= self._due_s(w)]

    def _due_s(self, worker: Worker) -> float:
        return worker.since_s + (self.deadline_s if worker.ready else START_DEADLINE_S)

    def next_deadline_s(self) -> float:
        """Return when the next load becomes overdue, or gets more places; infinity when nothing is loaded."""
        due_s = (min(self._due_s(w), self._stalled_s(w)) for w in self._workers.values() if w.queue)
        return min(due_s, default=math.inf)

    def end_workers(self) -> None:
        """End every worker."""
        for worker in self:
            self.remove(worker)
        for pidfd in list(self._ending):
            self._reap(pidfd)

    def close(self) -> None:
        """End every worker, and the parent process."""
        self.end_workers()
        self.parent.close()

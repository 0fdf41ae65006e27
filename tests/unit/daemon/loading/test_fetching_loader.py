# SPDX-License-Identifier: Apache-2.0
"""A loader that fetches what several jobs need at once, and the pool's account of it."""

from __future__ import annotations

import os
import socket
import subprocess
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from queue import SimpleQueue
from typing import Any, cast

import numpy as np
import pytest

from shmmap.daemon.loading import worker_messages
from shmmap.daemon.loading.prepared_parent import PreparedParent
from shmmap.daemon.loading.worker_main import _Worker
from shmmap.daemon.loading.worker_messages import Begun, Check, Done, Failed, Job, Ready
from shmmap.daemon.loading.worker_pool import JOBS_AHEAD, WorkerPool
from shmmap.daemon.transport.watched_descriptors import WatchedDescriptors
from shmmap.errors import Offline
from shmmap.layers.contract import Box
from shmmap.layers.sources import FILES, CellJob, CellSource
from shmmap.layers.spec import LayerSpec
from shmmap.processes.start_child import MAX_PACKET_BYTES
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.layout import SegmentHeader
from shmmap.segment.version import Source, Stamp
from tests.support.divided_map import random_points, write_pcd

BOX = (0.0, 0.0, 20.0, 20.0)
PATIENCE_S = 60.0


class Store:
    """Sources that come when the test says so; their words are a path."""

    def __init__(self) -> None:
        self.fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self.begun: SimpleQueue[int] = SimpleQueue()
        self._come: deque[int] = deque()
        self.lost: set[str] = set()

    def come(self, number: int) -> None:
        """What a job needs is here."""
        self._come.append(number)
        os.eventfd_write(self.fd, 1)

    # --- Fetcher

    @property
    def fetcher(self) -> Store:
        return self

    def begin(self, number: int, spec: LayerSpec, job: CellJob) -> None:
        del spec, job
        self.begun.put(number)

    def done(self) -> int | None:
        if not self._come:
            os.eventfd_read(self.fd)
            return None
        number = self._come.popleft()
        if not self._come:
            os.eventfd_read(self.fd)
        return number

    # --- SourceReader

    def _file(self, source: Source) -> Source:
        if source.name in self.lost:
            raise Offline(f"{source.name}: the store does not answer")
        return Source(source.words.decode())

    def stamp(self, source: Source) -> Stamp | None:
        return FILES.stamp(Source(source.words.decode()))

    def read(self, source: Source, box: Box, needs: Sequence[str] | None) -> CellSource:
        return FILES.read(self._file(source), box, needs)

    def fill(
        self, spec: LayerSpec, job: CellJob, fd: int, *, reserve: Callable[[int], None] | None,
        warn: Callable[[str], None],
    ) -> SegmentHeader | None:  # fmt: skip
        there = CellJob(job.cell_id, self._file(job.source), job.box, job.frame_id)
        return FILES.fill(spec, there, fd, reserve=reserve, warn=warn)

    def named(self, message: str) -> str:
        return message

    def explain(self, source: Source, message: str) -> str:
        del source
        return message

    def take_counts(self) -> tuple[int, ...]:
        return ()


class Loader:
    """One that works in a thread, and our end of its channel."""

    def __init__(self, path: Path) -> None:
        self.store, self.path = Store(), path
        self.channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.channel.settimeout(PATIENCE_S)
        worker = _Worker(theirs, ShmDirectory("/dev/shm"), None, self.store, _light=True)

        def run() -> None:
            with theirs:
                worker.run()

        self._thread = threading.Thread(target=run)
        self._thread.start()
        assert isinstance(self.said(), Ready)

    def give(self, number: int, layer: str = "points") -> None:
        source = Source(f"cell {number}", str(self.path).encode())
        job = Job(number, f"/map/{number}", source, layer, BOX, "map", 1 << 30)
        fd = os.memfd_create("segment")
        socket.send_fds(self.channel, [worker_messages.encode(job)], [fd])
        os.close(fd)

    def said(self) -> worker_messages.FromWorker:
        data, fds, _, _ = socket.recv_fds(self.channel, MAX_PACKET_BYTES, 1)
        for fd in fds:
            os.close(fd)
        message: worker_messages.FromWorker = worker_messages.decode_from_worker(data)
        return message

    def end(self) -> None:
        self.channel.close()
        self._thread.join(PATIENCE_S)
        os.close(self.store.fd)


@pytest.fixture
def loader(tmp_path: Path) -> Iterator[Loader]:
    write_pcd(tmp_path / "cell.pcd", random_points(np.random.default_rng(1), (0, 0), 100))
    one = Loader(tmp_path / "cell.pcd")
    yield one
    one.end()


def test_all_are_fetched_at_once_and_done_as_they_come(loader: Loader) -> None:
    for number in (1, 2, 3):
        loader.give(number)
    assert [loader.store.begun.get(timeout=PATIENCE_S) for _ in range(3)] == [1, 2, 3]
    for number in (3, 1, 2):
        loader.store.come(number)
        begun, done = loader.said(), loader.said()
        assert begun == Begun(number)
        assert isinstance(done, Done)
        assert (done.number, done.points) == (number, 100)


def test_another_job_is_fetched_while_one_waits(loader: Loader) -> None:
    loader.give(1)
    assert loader.store.begun.get(timeout=PATIENCE_S) == 1
    loader.give(2, "voxel(leaf=1.0)")
    assert loader.store.begun.get(timeout=PATIENCE_S) == 2
    loader.store.come(2)
    assert loader.said() == Begun(2)
    assert isinstance(loader.said(), Done)


def test_what_does_not_come_is_offline_and_the_others_are_not(loader: Loader) -> None:
    loader.store.lost.add("cell 1")
    for number in (1, 2):
        loader.give(number)
        loader.store.come(number)
    said = [loader.said() for _ in range(4)]
    assert said[0] == Begun(1)
    failed = said[1]
    assert isinstance(failed, Failed)
    assert (failed.number, failed.code, failed.unread) == (1, "offline", True)
    assert failed.stamp == FILES.stamp(Source(str(loader.path)))
    assert [type(one) for one in said[2:]] == [Begun, Done]


def test_a_check_is_done_meanwhile(loader: Loader) -> None:
    """It needs nothing that has to be fetched."""
    loader.give(1)
    source = Source("cell 2", str(loader.path).encode())
    loader.channel.send(
        worker_messages.encode(Check(2, source, "", FILES.stamp(Source(str(loader.path))) or b""))
    )
    assert loader.said() == Begun(2)
    assert loader.said() == worker_messages.Checked(2, "", FILES.stamp(Source(str(loader.path))))


# --- the pool ---------------------------------------------------------------------------------


class NoParent:
    """Makes no loader: what a pool sends lies in a channel."""

    def __init__(self) -> None:
        self.ends: list[socket.socket] = []

    def fork(self, end: socket.socket) -> None:
        self.ends.append(end.dup())

    def close(self) -> None:
        for end in self.ends:
            end.close()


@pytest.fixture
def pool() -> Iterator[WorkerPool]:
    directory, watched = ShmDirectory("/dev/shm"), WatchedDescriptors()
    one = WorkerPool(2, directory, cast("PreparedParent", NoParent()), 30.0, watched, places=3)
    one.on_message = lambda _worker: None
    yield one
    one.close()
    watched.close()
    directory.close()


def give(pool: WorkerPool, number: int, now_s: float, **words: Any) -> bool:
    job = Job(number, "cell", Source("cell"), words.pop("layer", "points"), BOX, "map", 0, **words)
    return pool.submit(job, now_s)


def test_free_places_are_counted_and_a_second_loader_comes_when_the_first_is_full(pool: WorkerPool) -> None:
    free = []
    for number in range(1, 7):
        free.append(pool.free_places)
        assert give(pool, number, 0.0)
    assert free == [6, 5, 4, 3, 2, 1]
    assert pool.free_places == 0
    assert [list(worker.queue) for worker in pool] == [[1, 2, 3], [4, 5, 6]]
    for number in range(7, 7 + 2 * JOBS_AHEAD):
        assert give(pool, number, 0.0), "some are given ahead"
    assert not pool.has_room(computed=False)


def test_a_layer_that_lies_ready_is_no_computed_one(pool: WorkerPool) -> None:
    for number in (1, 2, 3):
        assert give(pool, number, 0.0, layer="ndt(leaf=2.0)", ready=7)
    (worker,) = pool
    assert worker.layers == 0
    assert give(pool, 4, 0.0, layer="ndt(leaf=2.0)")
    assert sum(one.layers for one in pool) == 1


def test_deadlines_count_from_the_begin_of_the_work(pool: WorkerPool) -> None:
    """What is only fetched has its own ones; a loader that says nothing at all hangs."""
    for number in (1, 2):
        give(pool, number, 0.0)
    (worker,) = pool
    with subprocess.Popen(["cat"], stdin=subprocess.PIPE) as loader:
        pool.begun(worker, loader.pid, os.pidfd_open(loader.pid), 1.0)
        assert (worker.at_work, pool.next_deadline_s()) == (0, 31.0)
        pool.works_on(worker, 2, 20.0)
        assert (worker.at_work, pool.next_deadline_s()) == (2, 50.0)
        fd, spent_s = pool.finished(worker, 2, 25.0)
        os.close(fd)
        assert (spent_s, worker.at_work, pool.next_deadline_s()) == (5.0, 0, 55.0)
        assert pool.overdue(54.9) == []
        assert pool.overdue(55.0) == [worker]

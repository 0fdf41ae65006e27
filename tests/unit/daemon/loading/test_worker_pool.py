# SPDX-License-Identifier: Apache-2.0
"""Which loader gets which job, when it is overdue, and what becomes of a pool whose processes vanish."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
from collections.abc import Iterator
from typing import Any, cast

import pytest

from shmmap.daemon.loading.prepared_parent import PreparedParent
from shmmap.daemon.loading.worker_messages import Check, Job
from shmmap.daemon.loading.worker_pool import JOBS_AHEAD, LAYERS_AHEAD, Work, Worker, WorkerPool
from shmmap.daemon.turns import WatchedDescriptors
from shmmap.protocol.messages import Selected
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.version import Source
from tests.support.daemon_process import stop, wait_ended
from tests.support.divided_map import DividedMap
from tests.unit.daemon.inner_daemon import Inner, names


class NoParent:
    """Forks no loader: what a pool sends lies in a channel."""

    def __init__(self) -> None:
        self.ends: list[socket.socket] = []

    def fork(self, end: socket.socket) -> None:
        self.ends.append(end.dup())

    def close(self) -> None:
        for end in self.ends:
            end.close()


class Jobs:
    """A pool, and jobs for it; ``given`` are their numbers by worker, in the order in which workers came."""

    def __init__(self, limit: int, places: int) -> None:
        self.watched, self.directory = WatchedDescriptors(), ShmDirectory("/dev/shm")
        parent = cast("PreparedParent", NoParent())
        self.pool = WorkerPool(
            limit, self.directory, parent, 30.0, self.watched, lambda _worker: None, places=places
        )
        self.number = 0

    def give(self, layer: str = "points", ready: int = 0) -> bool:
        self.number += 1
        job: Work = Job(self.number, "cell", Source("/cell.pcd"), layer, (0.0,) * 4, "map", 0, ready=ready)
        if layer == "check":
            job = Check(self.number, Source("/cell.pcd"), "", b"")
        return self.pool.has_room(computed=layer == "ndt" and not ready) and self.pool.submit(job, 0.0)

    @property
    def given(self) -> list[list[int]]:
        return [list(worker.queue) for worker in self.pool]

    def done(self, worker: Worker, number: int = 0, now_s: float = 1.0) -> float:
        fd, spent_s = self.pool.finished(worker, number or next(iter(worker.queue)), now_s)
        if fd >= 0:  # a check has none
            os.close(fd)
        return spent_s


@contextlib.contextmanager
def jobs(limit: int, places: int = 1) -> Iterator[Jobs]:
    one = Jobs(limit, places)
    try:
        yield one
    finally:
        one.pool.close()
        one.watched.close()
        one.directory.close()


@pytest.mark.parametrize("limit", [1, 2, 4])
def test_points_never_wait_behind_layers(limit: int) -> None:
    """However many layers were asked for before: one loader more is kept for points."""
    with jobs(limit) as one:
        layers = 0
        while one.give("ndt"):
            layers += 1
        assert layers == limit * (1 + LAYERS_AHEAD)
        assert len(one.pool) == limit
        assert one.give("points")
        *computing, last = one.pool
        assert (len(computing), last.for_points, list(last.queue)) == (limit, True, [one.number])
        assert not any(worker.for_points for worker in computing)
        while one.give("points") or one.give("check"):
            pass
        assert len(last.queue) == 1 + JOBS_AHEAD
        assert len(one.pool) == limit + 1, "and no second one"
        one.done(last)
        assert not one.give("ndt"), "it computes nothing"
        assert one.give("check")


def test_layers_get_their_share_of_loaders_that_points_keep_busy() -> None:
    """A free loader is offered to both; points keep a loader without layers as long as there is one."""
    with jobs(2) as one:
        while one.give("points"):
            pass
        assert one.given == [[1, 3, 5, 7, 9], [2, 4, 6, 8, 10]]
        assert not one.give("ndt")
        first, second = one.pool
        one.done(first)
        assert one.give("ndt")
        for _ in range(3):
            one.done(first)
        assert list(map(len, one.given)) == [2, 5]
        assert not one.give("points"), "not behind the layer"
        assert one.give("ndt")
        one.done(second)
        assert one.give("points")
        assert (first.layers, second.layers) == (2, 0)


def test_a_loader_that_waits_for_data_in_vain_gets_more_places() -> None:
    with subprocess.Popen(["cat"], stdin=subprocess.PIPE) as process, jobs(1, places=3) as one:
        while one.give():
            pass
        (worker,) = one.pool
        one.pool.begun(worker, process.pid, os.pidfd_open(process.pid), 0.0)  # which the pool kills
        assert 0 < one.pool.next_deadline_s() < 2
        one.pool.make_places(0.1)
        assert not one.give(), "it may just be about to get its data"
        one.pool.make_places(one.pool.next_deadline_s())
        assert [one.give() for _ in range(4)] == [True, True, True, False]
        assert one.pool.next_deadline_s() == 30.0, "once"
        one.pool.works_on(worker, 1, 2.0)
        while len(worker.queue) >= 3:
            one.done(worker)
        one.pool.make_places(2.0)
        assert one.pool.free_places == 1


def test_of_loaders_that_fetch_a_second_one_starts_when_the_first_is_full() -> None:
    with jobs(2, places=3) as one:
        for free in (6, 5, 4, 3, 2, 1):
            assert one.pool.free_places == free
            assert one.give()
        assert one.pool.free_places == 0
        assert one.given == [[1, 2, 3], [4, 5, 6]]
        for _ in range(2 * JOBS_AHEAD):
            assert one.give(), "some are given ahead"
        assert not one.give()


def test_a_layer_that_lies_ready_is_no_computed_one() -> None:
    with jobs(2, places=3) as one:
        for _ in range(3):
            assert one.give("ndt", ready=7)
        (worker,) = one.pool
        assert worker.layers == 0
        assert one.give("ndt")
        assert sum(worker.layers for worker in one.pool) == 1


def test_deadlines_count_from_the_begin_of_the_work() -> None:
    """What is only fetched has its own ones; a loader that sends nothing at all hangs."""
    with jobs(2, places=3) as one, subprocess.Popen(["cat"], stdin=subprocess.PIPE) as loader:
        assert one.give()
        assert one.give()
        (worker,), pool = one.pool, one.pool
        pool.begun(worker, loader.pid, os.pidfd_open(loader.pid), 1.0)
        assert (worker.at_work, pool.next_deadline_s()) == (0, 31.0)
        pool.works_on(worker, 2, 20.0)
        assert (worker.at_work, pool.next_deadline_s()) == (2, 50.0)
        assert one.done(worker, 2, 25.0) == 5.0
        assert (worker.at_work, pool.next_deadline_s()) == (0, 55.0)
        assert pool.overdue(54.9) == []
        assert pool.overdue(55.0) == [worker]


def test_a_loader_that_computes_does_not_hinder_points(
    inner: Inner, small_map: DividedMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a single loader, and a layer that is never finished."""
    monkeypatch.setenv("SHMMAP_TEST_WORKER", "hang:0_0.pcd")
    one = inner(small_map.root, workers=1)
    slow, quick = one.session(), one.session()
    one.ask(slow, Selected(1, ("0_0.pcd",), layers=("voxel(leaf=1.0)",), wait=900.0))
    one.run_until(lambda: [worker.layers for worker in one.pool] == [1])
    assert names(one.cells_for(Selected(2, ("20_20.pcd",), wait=900.0), quick)) == ["20_20.pcd"]
    assert {key.layer for key in one.ledger.by_key} == {"points"}
    one.run_until(lambda: all(worker.ready for worker in one.pool))
    one.offset_s += 301.0
    assert [failure.code for failure in one.cells_of(1).failed] == ["load_timeout"]


def test_a_dead_loader_gets_no_job(inner: Inner, small_map: DividedMap) -> None:
    """Until its parent has reported how it ended, only its pidfd shows that it is dead."""
    one = inner(small_map.root)
    one.everything()
    (worker,) = one.pool
    stop(one.pool.parent.pid)
    os.kill(worker.pid, signal.SIGKILL)
    assert wait_ended(worker.pid)
    small_map.change("0_0.pcd", 7)
    one.reload()
    one.ask(one.session(), Selected(2, ("0_0.pcd",), wait=30.0))
    for _ in range(3):
        one.turn()
    assert list(one.pool) == [worker]
    assert not worker.queue
    os.kill(one.pool.parent.pid, signal.SIGCONT)
    assert names(one.cells_of(2)) == ["0_0.pcd"]


def test_a_parent_that_vanishes_repeatedly(
    inner: Inner, small_map: DividedMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The cause is unknown; the load that ran each time is given up at last."""
    monkeypatch.setenv("SHMMAP_TEST_WORKER", "hang:0_0.pcd")
    one = inner(small_map.root)
    wanted = ("0_0.pcd", "20_20.pcd")
    one.ask(one.session(), Selected(1, wanted, wait=900.0))
    for _ in range(3):
        one.run_until(lambda: [worker.ready and len(worker.queue) for worker in one.pool] == [2])
        (worker,) = one.pool
        os.kill(one.pool.parent.pid, signal.SIGKILL)
        one.run_until(lambda gone=worker: gone not in list(one.pool))  # type: ignore[misc]
        assert wait_ended(worker.pid)
    reply: Any = one.cells_of(1)
    assert [failure.code for failure in reply.failed] == ["load_failed"]
    assert "its loaders vanish" in reply.failed[0].message
    assert names(reply) == ["20_20.pcd"]

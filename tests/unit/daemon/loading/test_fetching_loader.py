# SPDX-License-Identifier: Apache-2.0
"""A loader that fetches what several jobs need at once."""

from __future__ import annotations

import os
import socket
import threading
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from queue import SimpleQueue

import numpy as np
import pytest

from shmmap.daemon.loading import worker_messages
from shmmap.daemon.loading.worker_main import _Worker
from shmmap.daemon.loading.worker_messages import Begun, Check, Done, Failed, Job, Ready
from shmmap.errors import Offline
from shmmap.layers.sources import FILES, CellJob, Fetcher, Files
from shmmap.layers.spec import LayerSpec
from shmmap.processes.start_child import MAX_PACKET_BYTES
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.layout import SegmentHeader
from shmmap.segment.version import Source
from tests.support.divided_map import random_points, write_pcd

BOX = (0.0, 0.0, 20.0, 20.0)
TIMEOUT_S = 60.0


class Store(Files):
    """Sources that come when the test says so; all of them are one file."""

    def __init__(self, path: Path) -> None:
        super().__init__(lambda _name: str(path))
        self.fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC | os.EFD_SEMAPHORE)
        self.begun: SimpleQueue[int] = SimpleQueue()
        self._come: deque[int] = deque()
        self.lost: set[str] = set()

    def come(self, number: int) -> None:
        """What a job needs is here."""
        self._come.append(number)
        os.eventfd_write(self.fd, 1)

    @property
    def fetcher(self) -> Fetcher:  # type: ignore[override]
        return self

    def begin(self, number: int, spec: LayerSpec, job: CellJob) -> None:
        del spec, job
        self.begun.put(number)

    def take_done(self) -> int | None:
        os.eventfd_read(self.fd)
        return self._come.popleft()

    def fill(
        self,
        spec: LayerSpec,
        job: CellJob,
        fd: int,
        *,
        reserve: Callable[[int], None] | None,
        warn: Callable[[str], None],
    ) -> SegmentHeader | None:
        if job.source.name in self.lost:
            raise Offline(f"{job.source.name}: the store does not answer")
        return super().fill(spec, job, fd, reserve=reserve, warn=warn)


class Loader:
    """One that works in a thread, and our end of its channel."""

    def __init__(self, path: Path) -> None:
        self.store, self.path = Store(path), path
        self.channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.channel.settimeout(TIMEOUT_S)
        worker = _Worker(theirs, ShmDirectory("/dev/shm"), None, self.store, _light=True)

        def run() -> None:
            with theirs:
                worker.run()

        self._thread = threading.Thread(target=run)
        self._thread.start()
        assert isinstance(self.said(), Ready)

    def give(self, number: int, layer: str = "points") -> None:
        job = Job(number, f"/map/{number}", Source(f"cell {number}"), layer, BOX, "map", 1 << 30)
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
        self._thread.join(TIMEOUT_S)
        os.close(self.store.fd)


@pytest.fixture
def loader(tmp_path: Path) -> Iterator[Loader]:
    write_pcd(tmp_path / "cell.pcd", random_points(np.random.default_rng(1), (0, 0), 100))
    one = Loader(tmp_path / "cell.pcd")
    yield one
    one.end()


def test_all_are_fetched_at_once_and_done_as_they_come(loader: Loader) -> None:
    """What does not come is offline; a check, for which nothing has to be fetched, is done meanwhile."""
    stamp = FILES.stamp(Source(str(loader.path)))
    for number in (1, 2, 3):
        loader.give(number)
    assert [loader.store.begun.get(timeout=TIMEOUT_S) for _ in range(3)] == [1, 2, 3]
    loader.channel.send(worker_messages.encode(Check(4, Source("cell 4"), "", stamp or b"")))
    assert [loader.said(), loader.said()] == [Begun(4), worker_messages.Checked(4, "", stamp)]
    loader.store.lost.add("cell 1")
    for number in (3, 1, 2):
        loader.store.come(number)
        assert loader.said() == Begun(number)
        end = loader.said()
        if isinstance(end, Failed):
            assert (end.number, end.code, end.unread, end.stamp) == (1, "offline", True, stamp)
        else:
            assert isinstance(end, Done)
            assert (end.number, end.points) == (number, 100)
            assert number != 1

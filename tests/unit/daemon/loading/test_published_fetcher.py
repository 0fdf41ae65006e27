# SPDX-License-Identifier: Apache-2.0
"""Objects that never come whole hold up no others."""

from __future__ import annotations

import os
import select
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from types import SimpleNamespace
from typing import Any, cast

import pytest

pytest.importorskip("zstandard", reason="zstandard is not installed")

from shmmap.daemon.loading import published_reader
from shmmap.daemon.loading.published_reader import CONCURRENT_FETCHES, MAX_BYTES, ObjectFetcher, _Reports
from shmmap.daemon.loading.worker_messages import Arrived
from shmmap.errors import Offline
from shmmap.layers.points import LAYER
from shmmap.layers.spec import LayerSpec
from shmmap.origin.remote.published_object import ObjectName
from shmmap.origin.remote.transport import too_slow
from tests.support.interleaving import interleaved


class Objects:
    """Objects of which those whose digest begins with ``d`` drip until the test ends them."""

    def __init__(self) -> None:
        self.dripping = threading.Semaphore(0)
        self.ended = threading.Event()

    def read(self, digest: bytes, nbytes: int) -> memoryview:
        if digest.startswith(b"d"):
            self.dripping.release()
            self.ended.wait()
            raise too_slow("this one", 3.0)
        if digest.startswith(b"s"):
            raise Offline("the store says nothing")
        return memoryview(bytes(min(nbytes, 9)))


@pytest.fixture
def objects() -> Iterator[Objects]:
    one = Objects()
    yield one
    one.ended.set()


def begin(
    fetcher: ObjectFetcher,
    number: int,
    digest: bytes,
    monkeypatch: pytest.MonkeyPatch,
    nbytes: int = MAX_BYTES // 4,
) -> None:
    name = ObjectName(digest, nbytes, 1, b"")
    monkeypatch.setattr(published_reader, "needed_objects", lambda _spec, _job: iter([name]))
    fetcher.begin(number, cast("LayerSpec", LAYER), cast("Any", None))


def next_done(fetcher: ObjectFetcher) -> int | None:
    assert select.select([fetcher.fd], [], [], 60.0)[0]
    return fetcher.take_done()


def test_objects_that_drip_hold_up_no_others(objects: Objects, monkeypatch: pytest.MonkeyPatch) -> None:
    fetcher = ObjectFetcher(cast("Any", objects))
    for number in range(1, CONCURRENT_FETCHES + 1):
        begin(fetcher, number, b"d%d" % number, monkeypatch)
    for number in range(101, 111):
        begin(fetcher, number, b"healthy%d" % number, monkeypatch)
    assert {next_done(fetcher) for _ in range(10)} == set(range(101, 111))
    objects.ended.set()
    assert {next_done(fetcher) for _ in range(CONCURRENT_FETCHES)} == set(range(1, CONCURRENT_FETCHES + 1))

    objects.ended.clear()  # again: they have failed lately, and take no place from the beginning
    monkeypatch.setattr(published_reader, "SLOW_S", 1e9)
    for number in range(201, 201 + CONCURRENT_FETCHES):
        begin(fetcher, number, b"d%d" % (number - 200), monkeypatch)
    begin(fetcher, 301, b"healthy", monkeypatch)
    assert next_done(fetcher) == 301


def test_a_store_that_says_nothing_fails_what_is_queued(
    objects: Objects, monkeypatch: pytest.MonkeyPatch
) -> None:
    fetcher = ObjectFetcher(cast("Any", objects))
    for number in range(1, 4):
        begin(fetcher, number, b"d%d" % number, monkeypatch)
    for _ in range(3):
        objects.dripping.acquire()
    begin(fetcher, 4, b"silent", monkeypatch)
    begin(fetcher, 5, b"healthy", monkeypatch)
    assert {next_done(fetcher), next_done(fetcher)} == {4, 5}


def test_bytes_that_come_at_the_same_time_are_all_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[Arrived] = []

    def one_byte(reports: _Reports) -> None:
        reports.add(1, None)

    def after_one() -> _Reports:
        monkeypatch.setattr(published_reader, "REPORTED_S", 1e9)
        reports = _Reports(cast("Any", sent.append))
        one_byte(reports)
        one_byte(reports)
        monkeypatch.setattr(published_reader, "REPORTED_S", 0.0)
        return reports

    def fetched(reports: _Reports) -> None:
        reports.fetched(1, 3)

    for first in (one_byte, fetched):
        for reports in interleaved(after_one, first, one_byte):
            fetched(reports)
            assert sum(message.bytes for message in sent) == 3 + (first is one_byte)
            sent.clear()


Move = Callable[[ObjectFetcher], object]


class Loader:
    """A loader whose fetching threads run when the test says so."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._monkeypatch = monkeypatch
        self._submitted: deque[partial[None]] = deque()
        self._under_way = partial[None](print)
        self.done: list[int | None] = []

    def fetcher(self) -> ObjectFetcher:
        """Return one with a job that is done, another one's object under way, and two that have to wait."""
        self._monkeypatch.setattr(published_reader, "SLOW_S", 1e9)
        fetcher = ObjectFetcher(cast("Any", Objects()))
        fetcher._threads = cast("Any", self)
        fetcher._reports = cast("Any", SimpleNamespace(fetched=pow))
        for number in range(1, 5):
            begin(fetcher, number, b"%d" % number, self._monkeypatch, MAX_BYTES // 2)
        self._submitted.popleft()()
        self._under_way = self._submitted.popleft()
        self._monkeypatch.setattr(published_reader, "SLOW_S", 0.0)
        return fetcher

    def submit(self, work: Callable[..., None], *arguments: Any) -> None:
        if work.__name__ == "_fetch":
            self._submitted.append(partial(work, *arguments))

    def begin_another(self, fetcher: ObjectFetcher) -> None:
        """Begin a job that needs the object under way, too."""
        begin(fetcher, 5, b"2", self._monkeypatch)

    def take(self, fetcher: ObjectFetcher) -> None:
        self.done.append(fetcher.take_done())

    def end(self, _fetcher: ObjectFetcher) -> None:
        """End the fetch that is under way."""
        self._under_way()

    def watch(self, fetcher: ObjectFetcher) -> None:
        """Look once for slow objects."""
        sleep = iter([None])
        clock = SimpleNamespace(sleep=lambda _s: next(sleep), monotonic=time.monotonic)
        self._monkeypatch.setattr(published_reader, "time", clock)
        with suppress(StopIteration):
            fetcher._watch()

    def drain(self, fetcher: ObjectFetcher) -> None:
        """Do what is left to do."""
        while True:
            while self._submitted:
                self._submitted.popleft()()
            self.take(fetcher)
            if not self._submitted and self.done[-1] is None:
                return


@pytest.mark.parametrize(
    ("move", "jobs"), [("begin_another", [1, 2, 3, 4, 5]), ("take", [1, 2, 3, 4]), ("watch", [1, 2, 3, 4])]
)
def test_an_object_that_comes_while_something_else_happens(
    move: str, jobs: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every job is done once, and nothing is left."""
    loader = Loader(monkeypatch)
    other: Move = getattr(loader, move)
    for first, second in ((other, loader.end), (loader.end, other)):
        for fetcher in interleaved(loader.fetcher, first, second):
            loader.drain(fetcher)
            assert sorted(filter(None, loader.done)) == jobs
            assert (fetcher._fetches, fetcher._under_way, fetcher._held_bytes) == ({}, set(), 0)
            loader.done.clear()
            os.close(fetcher.fd)

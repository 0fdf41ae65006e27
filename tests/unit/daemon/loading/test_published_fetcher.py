# SPDX-License-Identifier: Apache-2.0
"""Objects that never come whole hold up no others."""

from __future__ import annotations

import select
import threading
from collections.abc import Iterator
from typing import Any, cast

import pytest

pytest.importorskip("zstandard", reason="zstandard is not installed")

from shmmap.daemon.loading import published_reader
from shmmap.daemon.loading.published_reader import CONCURRENT_FETCHES, MAX_BYTES, ObjectFetcher
from shmmap.errors import Offline
from shmmap.layers.points import LAYER
from shmmap.layers.spec import LayerSpec
from shmmap.origin.remote.published_object import ObjectName
from shmmap.origin.remote.transport import too_slow


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


def begin(fetcher: ObjectFetcher, number: int, digest: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    name = ObjectName(digest, MAX_BYTES // 4, 1, b"")
    monkeypatch.setattr(published_reader, "_needed", lambda _spec, _job: iter([name]))
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

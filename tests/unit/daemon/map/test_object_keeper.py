# SPDX-License-Identifier: Apache-2.0
"""Objects are on the disk before a loader needs them: fetched once, or with the reason why not."""

from __future__ import annotations

import hashlib
import random
import select
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from shmmap.daemon.map.object_keeper import THREADS, Kept, KeptCell, ObjectKeeper
from shmmap.origin.remote.object_tier import KeptObjects, ObjectCounts, ObjectTier
from shmmap.origin.remote.published_object import ObjectName, blob_path
from shmmap.processes.request_threads import have_ended
from tests.support.map_stores import MemoryStore

TIMEOUT_MS = 60_000
OBJECTS = [random.Random(number).randbytes(5_000 + number) for number in range(20)]


class Keeper:
    """A keeper with its store and tier, and how often it found the store away."""

    def __init__(self, cache: Path, limit_bytes: int = 1 << 30) -> None:
        self.store, self.failures = MemoryStore(), 0
        for data in OBJECTS:
            self.store.add(data)
        self.tier = ObjectTier(str(cache), limit_bytes=limit_bytes, quiet=True)
        self.keeper = ObjectKeeper(KeptObjects(self.store, self.tier), self.tier, self._failed)

    def _failed(self) -> None:
        self.failures += 1

    def keep(self, *numbers: int) -> Kept:
        """Ask for some objects together, and wait for the end."""
        names = []
        for number in numbers:
            digest = hashlib.sha256(OBJECTS[number]).digest()
            names.append(ObjectName(digest, len(OBJECTS[number]), 0, digest))
        self.keeper.keep(KeptCell(1, numbers[0], "points"), names)
        return self.done(1)[0]

    def done(self, count: int) -> list[Kept]:
        poll = select.poll()
        found: list[Kept] = []
        poll.register(self.keeper.fd, select.POLLIN)
        while len(found) < count:
            assert poll.poll(TIMEOUT_MS)
            found += self.keeper.take()
        return found


@pytest.fixture
def one(tmp_path: Path) -> Iterator[Keeper]:
    keeper = Keeper(tmp_path / "cache")
    yield keeper
    assert have_ended(keeper.keeper.close())


def test_what_is_kept_is_not_fetched_again(one: Keeper) -> None:
    key = KeptCell(1, 0, "points")
    assert one.keep(0, 1) == Kept(key, True)
    size = len(OBJECTS[0]) + len(OBJECTS[1])
    assert one.keeper.counts == ObjectCounts(fetched_objects=2, fetched_bytes=size)
    one.store.is_out = True
    assert one.keep(0, 1) == Kept(key, True), "and nothing is read or fetched for that"
    assert one.keeper.counts == ObjectCounts(fetched_objects=2, fetched_bytes=size)
    assert one.tier.get(hashlib.sha256(OBJECTS[1]).digest(), len(OBJECTS[1])) == OBJECTS[1]
    assert one.keeper.free_places == THREADS


def test_what_cannot_be_had(one: Keeper) -> None:
    one.store.is_out = True
    assert one.keep(2) == Kept(KeptCell(1, 2, "points"), False)
    assert one.failures == 1
    one.store.is_out = False
    path = blob_path(hashlib.sha256(OBJECTS[2]).digest())
    one.store.objects[path] = bytes(len(OBJECTS[2]))
    assert not one.keep(2).is_here, "damaged"
    del one.store.objects[path]
    assert not one.keep(2).is_here, "a defect of the store costs no thread"
    assert one.failures == 1


def test_many_at_once(one: Keeper) -> None:
    for number, data in enumerate(OBJECTS):
        digest = hashlib.sha256(data).digest()
        one.keeper.keep(KeptCell(1, number, "points"), [ObjectName(digest, len(data), 0, digest)])
    assert one.keeper.free_places < 0
    assert {kept.key.cell for kept in one.done(len(OBJECTS)) if kept.is_here} == set(range(len(OBJECTS)))


def test_a_disk_without_room_is_said(tmp_path: Path) -> None:
    small = Keeper(tmp_path / "cache", limit_bytes=100)
    assert small.keep(3) == Kept(KeptCell(1, 3, "points"), False, has_no_room=True)
    assert have_ended(small.keeper.close())


def test_without_a_thread_nothing_stays_pending(one: Keeper, monkeypatch: pytest.MonkeyPatch) -> None:
    """The system allows no more of them for a while."""

    def refuse(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", refuse)
        for number in range(2 * THREADS):
            assert not one.keep(number).is_here
    assert one.keeper.free_places == THREADS
    assert one.keep(0).is_here

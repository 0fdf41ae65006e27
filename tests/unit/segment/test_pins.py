# SPDX-License-Identifier: Apache-2.0
"""What the kernel says of a segment's users."""

from __future__ import annotations

import fcntl
import mmap
import os
import random
import signal
import struct
import subprocess
import sys
from collections.abc import Iterator
from typing import Any, Final

import numpy as np
import pytest
from numpy.typing import NDArray

from shmmap.segment import pins
from shmmap.segment.attach import AttachedSegment, attach
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.header import PublishBlock
from shmmap.segment.pins import MAX_SLOT, holders, in_use, lock_slot, prepare_process
from tests.support.segments import publish_segment
from tests.unit.segment.conftest import Publish


@pytest.fixture(autouse=True)
def sigio() -> Iterator[None]:
    """A process that takes leases ignores SIGIO."""
    before = signal.getsignal(signal.SIGIO)
    prepare_process()
    yield
    signal.signal(signal.SIGIO, before)


def pinned(shm: ShmDirectory, name: str) -> bool:
    fd = shm.open(name)
    try:
        return in_use(fd)
    finally:
        os.close(fd)


def slots_of(shm: ShmDirectory, name: str) -> list[int]:
    fd = shm.open(name)
    try:
        return holders(fd)
    finally:
        os.close(fd)


def test_an_open_file_and_a_mapping_are_uses(shm: ShmDirectory, publish: Publish) -> None:
    name = publish()
    assert not pinned(shm, name)
    fd = shm.open(name)
    assert pinned(shm, name)
    mapped = mmap.mmap(fd, 0, prot=mmap.PROT_READ)
    os.close(fd)
    assert pinned(shm, name)
    mapped.close()
    assert not pinned(shm, name)


_READER: Final = """
import sys
from shmmap.segment.attach import attach
sys.stdin.readline()
print(len(attach(sys.argv[1], shm_dir=sys.argv[2], slot=5).columns), flush=True)
"""


@pytest.mark.parametrize("elsewhere", [False, True])
def test_looking_does_not_disturb_an_open_meanwhile(
    monkeypatch: pytest.MonkeyPatch, shm: ShmDirectory, elsewhere: bool
) -> None:
    """An open that meets a lease is tried until the lease is given back, and succeeds.

    The test holds the lease until the kernel says that an open breaks it: the reader is in the middle of
    its open then.  In the usual directory, and in another.
    """
    directory = ShmDirectory(shm.path) if elsewhere else ShmDirectory()
    columns: dict[str, NDArray[Any]] = {"xyz": np.zeros((9, 3), np.float32)}
    name, _ = publish_segment(directory, columns, block=PublishBlock(7, 8), instance=f"unit-{os.getpid()}")
    fd = directory.open(name)
    met: list[int] = []
    try:
        with subprocess.Popen(
            [sys.executable, "-c", _READER, name, directory.path],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        ) as reader:
            assert reader.stdin is not None
            assert reader.stdout is not None

            def hold(label: str) -> None:
                """Keep the lease until the reader has met it."""
                assert label == "daemon.probe"
                assert reader.stdin is not None
                reader.stdin.write("go\n")
                reader.stdin.flush()
                while reader.poll() is None and fcntl.fcntl(fd, fcntl.F_GETLEASE) == fcntl.F_WRLCK:
                    os.sched_yield()
                met.append(fcntl.fcntl(fd, fcntl.F_GETLEASE))

            monkeypatch.setattr(pins, "step", hold)
            assert not in_use(fd)
            assert met == [fcntl.F_RDLCK], "the kernel asks for it back, so that a reader can go on"
            assert reader.stdout.readline() == "1\n"
            assert reader.wait() == 0
    finally:
        os.close(fd)
        directory.unlink(name)
        directory.close()


def test_slots_of_holders(shm: ShmDirectory, publish: Publish) -> None:
    name = publish()
    slots = [0, 1, 2, 5, 1000, 2**32, 2**61 + 1, MAX_SLOT]
    held = [attach(name, shm_dir=shm.path, slot=slot) for slot in slots]
    anonymous = attach(name, shm_dir=shm.path)
    assert slots_of(shm, name) == slots
    del held[3]
    assert slots_of(shm, name) == [s for s in slots if s != 5]
    held.clear()
    assert slots_of(shm, name) == []
    assert pinned(shm, name)  # by the one without a slot
    assert anonymous.published is not None
    del anonymous
    assert not pinned(shm, name)


def test_locks_over_ranges_count_as_no_holder_and_hide_none(shm: ShmDirectory, publish: Publish) -> None:
    name = publish()
    other_fd = shm.open(name)
    fcntl.fcntl(other_fd, 37, struct.pack("@hhqqi4x", fcntl.F_RDLCK, 0, 100, 50, 0))
    held = attach(name, shm_dir=shm.path, slot=99), attach(name, shm_dir=shm.path, slot=150)
    assert slots_of(shm, name) == [99, 150]
    os.close(other_fd)
    del held


def test_readers_cannot_take_the_writer_s_lock(shm: ShmDirectory, publish: Publish) -> None:
    fd = shm.open(publish())
    with pytest.raises(OSError, match="Bad file descriptor"):
        fcntl.fcntl(fd, 37, struct.pack("@hhqqi4x", fcntl.F_WRLCK, 0, 0, 1, 0))
    lock_slot(fd, 5)
    os.close(fd)


def test_random_steps_against_a_model(shm: ShmDirectory, publish: Publish) -> None:
    """Many segments, mapped and dropped in any order: pins and holders are always exact."""
    rng = random.Random(11)
    names = [publish(seed=i) for i in range(6)]
    held: dict[str, list[tuple[int | None, AttachedSegment]]] = {name: [] for name in names}
    ending = dict.fromkeys(names, "")
    for _ in range(400):
        name = rng.choice(names)
        current = name + ending[name]
        action = rng.randrange(4)
        if action == 0 and len(held[name]) < 5:
            slot = rng.choice([None, rng.randrange(MAX_SLOT)])
            held[name].append((slot, attach(current, shm_dir=shm.path, slot=slot)))
        elif action == 1 and held[name]:
            held[name].pop(rng.randrange(len(held[name])))
        elif action == 2:
            ending[name] = "" if ending[name] else ".zombie"
            assert shm.rename(current, name + ending[name])
            current = name + ending[name]
        assert pinned(shm, current) == bool(held[name])
        assert slots_of(shm, current) == sorted({slot for slot, _ in held[name] if slot is not None})


def test_asking_for_holders_without_number_ends(
    shm: ShmDirectory, publish: Publish, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After its timeout the look returns what it has found."""
    name = publish()
    other_fd = shm.open(name)
    slots = range(1, 600, 3)
    for slot in slots:
        lock_slot(other_fd, slot)
    fd = shm.open(name)
    assert holders(fd) == list(slots)
    monkeypatch.setattr(pins, "TIMEOUT_S", 0.0)
    found = holders(fd)
    os.close(fd)
    os.close(other_fd)
    assert 0 < len(found) < 16
    assert set(found) <= set(slots)

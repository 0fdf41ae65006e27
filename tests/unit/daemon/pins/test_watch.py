# SPDX-License-Identifier: Apache-2.0
"""Which processes use a segment, by each source; and which closes are reported."""

from __future__ import annotations

import os
import select

import pytest

from shmmap.daemon.pins.probe import PinSource, PinSupport, probe_pins
from shmmap.daemon.pins.watch import PinWatch
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.pins import prepare_process
from tests.support.segment_reader import map_segment

NAME = "/shmmap.unit.0011223344556677"


@pytest.fixture
def directory(shm: ShmDirectory) -> ShmDirectory:
    """Return a private directory with one named file of a page."""
    prepare_process()
    fd = shm.create()
    os.ftruncate(fd, 4096)
    shm.link(fd, NAME)
    os.close(fd)
    return shm


def reported(fd: int, timeout_s: float = 10.0) -> bool:
    return bool(select.select([fd], [], [], timeout_s)[0])


def test_this_machine_knows_everything(directory: ShmDirectory) -> None:
    support = probe_pins(directory)
    assert support == PinSupport(True, True, True)
    assert support.source is PinSource.LEASES
    assert os.listdir(directory.path) == [NAME[1:]]


@pytest.mark.parametrize(("less", "source"), [("locks", PinSource.LOCKS), ("sessions", PinSource.SESSIONS)])
def test_the_next_best_source_is_taken(
    directory: ShmDirectory, monkeypatch: pytest.MonkeyPatch, less: str, source: PinSource
) -> None:
    monkeypatch.setenv("SHMMAP_TEST_PINS", less)
    assert probe_pins(directory).source is source


@pytest.mark.parametrize(
    ("source", "lock", "used"),
    [
        (PinSource.LEASES, 77, True),
        (PinSource.LEASES, None, True),
        (PinSource.LOCKS, 77, True),
        (PinSource.LOCKS, None, False),  # overlooked, as documented
    ],
)
def test_use(directory: ShmDirectory, source: PinSource, lock: int | None, used: bool) -> None:
    pins = PinWatch(directory, source)
    assert pins.is_used(NAME) is False
    mapping = map_segment(directory.path + NAME, lock)
    assert pins.is_used(NAME) is used
    mapping.close()
    assert pins.is_used(NAME) is False
    directory.unlink(NAME)
    assert pins.is_used(NAME) is None


def test_closes_of_a_kept_segment_are_reported(directory: ShmDirectory) -> None:
    pins = PinWatch(directory, events=True)
    retired = NAME + ".zombie"
    descriptors = len(os.listdir("/proc/self/fd"))
    mapping = map_segment(directory.path + NAME, 5)
    directory.rename(NAME, retired)
    assert pins.keep(retired)
    for _ in range(3):
        assert pins.is_used(retired) is True
    with pins.opened(retired) as fd:
        assert fd > 0
    assert not reported(pins.fd, 0)  # its own looks are not reported
    mapping.close()
    assert reported(pins.fd)
    assert pins.closed() == {retired}
    assert pins.is_used(retired) is False
    directory.unlink(retired)  # its memory goes when it is released
    pins.release(retired)
    assert not pins.keeps(retired)
    assert len(os.listdir("/proc/self/fd")) == descriptors
    assert pins.closed() == set()
    pins.close()


def test_one_close_of_a_segment_in_service_is_reported(directory: ShmDirectory) -> None:
    pins = PinWatch(directory, events=True)
    first, second = (map_segment(directory.path + NAME) for _ in range(2))
    pins.watch_next_close(NAME)
    first.close()
    assert reported(pins.fd)
    assert pins.closed() == {NAME}
    second.close()
    assert pins.closed() == set()
    pins.close()


def test_our_own_look_is_no_close(directory: ShmDirectory) -> None:
    """Otherwise a load that waits for room would find closes as long as it looks."""
    pins = PinWatch(directory, events=True)
    first = map_segment(directory.path + NAME)
    for _ in range(3):
        pins.watch_next_close(NAME)
        assert pins.is_used(NAME) is True
        assert pins.closed() == set()
    first.close()
    assert reported(pins.fd)
    assert pins.closed() == {NAME}, "although it was looked at meanwhile"
    assert pins.is_used(NAME) is False
    assert pins.closed() == set()
    pins.close()


def test_a_close_before_our_own_look_counts(directory: ShmDirectory) -> None:
    pins = PinWatch(directory, events=True)
    first = map_segment(directory.path + NAME)
    pins.watch_next_close(NAME)
    first.close()
    assert pins.is_used(NAME) is False
    assert pins.closed() == {NAME}
    pins.close()


def test_without_events_nothing_is_kept(directory: ShmDirectory) -> None:
    pins = PinWatch(directory)
    assert (pins.fd, pins.keep(NAME), pins.keeps(NAME), pins.closed()) == (-1, False, False, set())
    pins.watch_next_close(NAME)
    pins.close()

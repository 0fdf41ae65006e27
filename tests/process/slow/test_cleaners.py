# SPDX-License-Identifier: Apache-2.0
"""Other programs remove or damage what the daemon has: logind's RemoveIPC, cleaners of temporary files."""

from __future__ import annotations

import os
import re
from functools import partial
from pathlib import Path

import pytest

from shmmap import connect
from shmmap.errors import SegmentCorrupt
from shmmap.statistics.reader import read_statistics
from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import TIMEOUT_S, DaemonProcess, counters, until
from tests.support.divided_map import DividedMap


def remove_segments(one: DaemonProcess) -> int:
    """Remove what a cleaner removes; returns how many segments there were."""
    names = one.segments()
    for name in names:
        os.unlink(f"{one.shm_dir}/{name}")
    return len(names)


def tight(daemon: DaemonFactory, divided_map: DividedMap) -> tuple[DaemonProcess, int]:
    """A daemon whose budget the map takes by more than half, and how many bytes that is."""
    for number, name in enumerate(divided_map.corners):
        divided_map.change(name, number)
    one = daemon(divided_map.root, "--budget", "1M")
    with connect(one.endpoint) as client:
        assert len(client.selected(list(divided_map.corners), wait=TIMEOUT_S)) == 36
    return one, one.segment_bytes()


@pytest.mark.parametrize("how", ["idle", "held by a client", "pinned by an operator", "twice", "some"])
def test_removed_segments_cost_no_memory(daemon: DaemonFactory, divided_map: DividedMap, how: str) -> None:
    """Their bytes are released, their cells are loaded again, and one line says what is likely."""
    one, nbytes = tight(daemon, divided_map)
    assert 2 * nbytes + counters(one)["bytes_statistics"] > 1 << 20, "both together would not fit"
    cells = list(divided_map.corners)
    with connect(one.endpoint) as client:
        held = client.selected(cells, wait=TIMEOUT_S) if how.startswith("held") else ()
        if how.startswith("pinned"):
            client.pin(cells[:3])
        for _ in range(2 if how == "twice" else 1):
            removed = 1 if how == "some" else 36
            for name in one.segments()[:removed]:
                os.unlink(f"{one.shm_dir}/{name}")
            with connect(one.endpoint) as another:  # it has nothing mapped
                again = another.selected(cells, wait=TIMEOUT_S)
            assert (len(again), again.failed, again.pending) == (36, (), ())
        assert all(len(cell.xyz) == 700 for cell in held), "a process keeps what it maps"
        until(lambda: counters(one)["bytes_resident"] == nbytes, lambda: str(counters(one)))
        until(lambda: counters(one)["bytes_zombie"] == 0, lambda: str(counters(one)))
        if how.startswith("pinned"):
            assert {cell.state for cell in client.pin().cells} == {"resident"}

    def lines() -> list[str]:
        return [line for line in one.log.splitlines() if "segments lost to other programs" in line]

    def logged() -> int:
        return sum(int(re.findall(r"removed=(\d+) ", line)[0]) for line in lines())

    times = 2 if how == "twice" else 1
    until(lambda: logged() >= removed * times, lambda: one.log)
    assert logged() == removed * times
    assert len(lines()) <= times
    assert "RemoveIPC" in lines()[0]


def test_evict_all_after_a_cleaner(daemon: DaemonFactory, divided_map: DividedMap) -> None:
    one, _ = tight(daemon, divided_map)
    remove_segments(one)
    with connect(one.endpoint) as client:
        client.evict(None)
        until(lambda: counters(one)["bytes_resident"] == 0, lambda: str(counters(one)))
        until(lambda: counters(one)["bytes_zombie"] == 0, lambda: str(counters(one)))
        assert len(client.selected(list(divided_map.corners), wait=TIMEOUT_S)) == 36


def test_retired_segments_that_a_cleaner_removes(daemon: DaemonFactory, divided_map: DividedMap) -> None:
    """What clients map counts until they release it, as the kernel says; a name is not needed for that."""
    one, nbytes = tight(daemon, divided_map)
    with connect(one.endpoint) as client:
        held = list(client.selected(list(divided_map.corners)[:6], wait=TIMEOUT_S))
        client.evict(None)
        until(lambda: counters(one)["zombies"] == 6, lambda: str(counters(one)))
        remove_segments(one)
        assert len(client.selected(list(divided_map.corners)[:6], wait=TIMEOUT_S)) == 6, "loaded again"
        assert len(held) == 6
        del held
        until(lambda: counters(one)["bytes_zombie"] == 0, lambda: str(counters(one)))
        assert len(client.selected(list(divided_map.corners), wait=TIMEOUT_S)) == 36
        until(lambda: counters(one)["bytes_resident"] == nbytes, lambda: str(counters(one)))


@pytest.mark.parametrize("how", ["cut", "emptied", "replaced"])
def test_a_damaged_segment_is_loaded_again(served: DaemonProcess, how: str) -> None:
    """Its cell fails at most until the daemon has looked, not until it is started again."""
    with connect(served.endpoint) as client:
        client.selected(["0_0.pcd"], wait=TIMEOUT_S)
        (name,) = served.segments()
        path = f"{served.shm_dir}/{name}"
        if how == "replaced":
            os.unlink(path)
            Path(path).write_bytes(b"")
        else:
            os.chmod(path, 0o600)  # an ordinary user may not write what it made read-only
            os.truncate(path, 4096 if how == "cut" else 0)
    with connect(served.endpoint) as client:  # it has nothing mapped
        until(lambda: len(client.selected(["0_0.pcd"], wait=1.0)) == 1, lambda: served.log)
        assert len(client.selected(["0_0.pcd"], wait=TIMEOUT_S)[0].xyz) == 500
    if how == "replaced":
        Path(path).unlink(missing_ok=True)  # it came after the daemon had looked: it is the other program's
    else:
        until(lambda: "cut_short=1" in served.log, lambda: served.log)


@pytest.mark.parametrize("how", ["removed", "replaced", "removed twice"])
def test_the_statistics_come_back(daemon: DaemonFactory, divided_map: DividedMap, how: str) -> None:
    one, nbytes = tight(daemon, divided_map)
    path = f"{one.shm_dir}/shmmap.{one.instance}.statistics"
    mode, rows = os.stat(path).st_mode, 36
    until(partial(resident, one, rows), lambda: one.log)
    for _ in range(2 if how == "removed twice" else 1):
        before = Path(path).stat().st_ino
        os.unlink(path)
        if how == "replaced":
            Path(path).write_text("another program's")
        until(partial(remade, one, path, before), lambda: one.log)
    found = read_statistics(one.instance, one.shm_dir)
    assert found.identity is not None
    assert (found.identity.pid, os.stat(path).st_mode) == (one.pid, mode)
    assert found.counters["bytes_resident"] == nbytes
    until(lambda: "statistics made again" in one.log, lambda: one.log)
    with connect(one.endpoint) as client:
        client.evict(["0_0.pcd"])
        until(partial(resident, one, rows - 1), lambda: one.log)


def resident(one: DaemonProcess, count: int) -> bool:
    return read_statistics(one.instance, one.shm_dir).counters["cells_resident"] == count


def remade(one: DaemonProcess, path: str, before: int) -> bool:
    try:
        healthy = read_statistics(one.instance, one.shm_dir).state == "healthy"
    except SegmentCorrupt:  # what stands in its place is no statistics
        return False
    return healthy and os.stat(path).st_ino != before

# SPDX-License-Identifier: Apache-2.0
"""A process that maps a segment keeps it, whatever it is and whatever happens; no other does."""

from __future__ import annotations

import os
import select
import signal
import zlib
from pathlib import Path

import pytest

import shmmap
from shmmap.daemon.host.inotify import NAME_GONE, Inotify
from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import DaemonProcess, Deadline, first_answer, until
from tests.support.divided_map import DividedMap
from tests.support.mapping_process import MappingProcess
from tests.support.raw_client import RawClient, circle


def test_evicting_everything_frees_what_is_not_mapped(served: DaemonProcess, client: RawClient) -> None:
    handles = client.area(circle(0, 0, 25)).cells
    paths = [client.path(handle) for handle in handles[:2]]
    expected = [zlib.crc32(Path(path).read_bytes()) for path in paths]
    with MappingProcess(paths) as reader:
        evicted = client.ask("evict")
        assert (evicted[2], evicted[3]) == (len(handles) - 2, 2)
        served.until_segments(2, lambda: client.ask("stats"))
        assert all(name.endswith(".zombie") for name in served.segments())
        until(lambda: client.ask("stats")[4]["zombies"] == 2)
        os.kill(reader.pid, signal.SIGSTOP)
        client.ask("evict")
        os.kill(reader.pid, signal.SIGCONT)
        assert reader.checksums() == expected
        # a retired segment that is wanted again is put back, not loaded a second time
        loads = client.ask("stats")[4]["loads_finished"]
        again = client.selected([handles[0].id]).cells[0]
        assert again.segment == handles[0].segment
        assert client.ask("stats")[4]["loads_finished"] == loads
        client.ask("evict")
    served.until_segments(0, lambda: client.ask("stats"))


def test_a_stopped_process_without_a_session_keeps_its_bytes_across_a_restart(
    served: DaemonProcess, client: RawClient
) -> None:
    """Plain open and mmap, SIGSTOP, a daemon that is killed and comes back: nothing gets lost."""
    handle = client.selected(["0_0.pcd"]).cells[0]
    expected = zlib.crc32(Path(client.path(handle)).read_bytes())
    with MappingProcess([client.path(handle)]) as process:
        os.kill(process.pid, signal.SIGSTOP)
        served.kill()
        served.start()
        client.hello()
        # while a loader compares it with its checksums, other holders are not known
        stats = first_answer(lambda: client.ask("stats"), lambda found: found[6])
        assert (stats[6], stats[7] >= handle.bytes) == (1, True)
        client.ask("evict")
        assert len(served.segments()) == 1
        stats = first_answer(lambda: client.ask("stats"), lambda found: found[6])
        assert (stats[6], stats[7] >= handle.bytes) == (1, True)
        os.kill(process.pid, signal.SIGCONT)
        assert process.checksums() == [expected]
    served.until_segments(0, lambda: client.ask("stats"))
    stats = client.ask("stats")
    assert (stats[6], stats[7]) == (0, 0)


def test_clients_that_die_release_their_cells(served: DaemonProcess, client: RawClient) -> None:
    paths = [client.path(handle) for handle in client.area(circle(0, 0, 60)).cells]
    readers = [MappingProcess(paths[i::4]) for i in range(4)]
    try:
        os.kill(readers[0].pid, signal.SIGSTOP)
        client.ask("evict")
        assert len(served.segments()) == len(paths)
    finally:
        for reader in readers:
            reader.end()
    served.until_segments(0, lambda: client.ask("stats"))


@pytest.mark.parametrize("at_once", [False, True])
def test_names_removed_behind_the_daemon_s_back(
    served: DaemonProcess, client: RawClient, at_once: bool
) -> None:
    """``rm /dev/shm/*``: readers keep what they map, the cells are loaded again, the books stay right."""
    handles = client.area(circle(0, 0, 25)).cells
    kept = client.path(handles[0])
    expected = zlib.crc32(Path(kept).read_bytes())
    with MappingProcess([kept]) as reader:
        for handle in handles if at_once else handles[:1]:
            os.unlink(client.path(handle))
        again = first_answer(
            lambda: client.area(circle(0, 0, 25)).cells,
            lambda cells: all(Path(client.path(cell)).exists() for cell in cells),
        )
        assert again[0].segment != handles[0].segment
        assert reader.checksums() == [expected]
    until(lambda: client.ask("stats")[4]["bytes_resident"] == served.segment_bytes())


@pytest.mark.parametrize("source", ["locks", "sessions"])
def test_where_there_are_no_leases(daemon: DaemonFactory, divided_map: DividedMap, source: str) -> None:
    """What clients of the library hold is known by their locks, or by what they say; it says so itself."""
    one = daemon(divided_map.root, environment={"SHMMAP_TEST_PINS": source})
    with shmmap.connect(one.endpoint) as client:
        held = client.around(0, 0, 25).raise_for_failures()
        expected = [zlib.crc32(cell.xyz.data) for cell in held]
        assert client.stats().counters["pin_source"] == {"locks": 1, "sessions": 2}[source]
        evicted = client.evict()
        assert (evicted.freed, evicted.pinned) == (0, len(held))
        assert len(one.segments()) == len(held)
        assert [zlib.crc32(cell.xyz.data) for cell in held] == expected
        del held
        client.release()
        one.until_segments(0, client.stats)
    assert "grants no leases" in one.log


def test_a_retired_segment_goes_when_its_reader_does_without_a_request(
    served: DaemonProcess, client: RawClient
) -> None:
    """No request says so: the kernel reports that the mapping is gone."""
    handle = client.selected(["0_0.pcd"]).cells[0]
    events = Inotify()
    with MappingProcess([client.path(handle)]):
        client.ask("evict")
        assert len(served.segments()) == 1
        events.add(served.shm_dir, NAME_GONE)
    waiting = Deadline()
    while waiting(bool(served.segments())):
        select.select([events.fd], [], [], 1.0)
        events.read()
    events.close()

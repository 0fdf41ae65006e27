# SPDX-License-Identifier: Apache-2.0
"""What outlives the daemon serves again, once its bytes are proven; nothing else that is left ever does."""

from __future__ import annotations

import os
import shutil
import signal
import threading
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import shmmap
from shmmap.segment.pins import lock_slot
from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import DaemonProcess, Deadline, wait_ended
from tests.support.divided_map import DividedMap, random_points
from tests.support.mapping_process import MappingProcess
from tests.support.raw_client import DaemonError, RawCells, RawClient, circle
from tests.support.segment_reader import read_segment
from tests.support.segments import (
    damage_header,
    damage_payload,
    damage_publish_block,
    other_builder,
    other_layout,
    punch,
    shorten,
)

Connect = Callable[..., RawClient]
EVERYTHING = circle(0, 0, 500)


def assert_right(client: RawClient, reply: RawCells, made: DividedMap) -> None:
    """Every handle leads to exactly the bytes of its file."""
    assert (reply.failed, reply.pending) == ([], [])
    for handle in reply.cells:
        segment = read_segment(client.path(handle))
        assert (segment.fields["cell_id"], segment.version) == (handle.id, handle.version)
        expected = made.points(handle.id.rsplit("/", 1)[1])
        assert segment.columns["xyz"][:, 2].tobytes() == expected["z"].tobytes()
        assert segment.columns["intensity"].tobytes() == expected["intensity"].tobytes()


def segments_of(reply: RawCells) -> dict[str, str]:
    return {handle.id: handle.segment for handle in reply.cells}


@pytest.mark.parametrize("end", ["kill", "leave"])
def test_what_was_loaded_serves_again(
    served: DaemonProcess, client: RawClient, divided_map: DividedMap, end: str
) -> None:
    """After a crash and after a restart alike: the same segments, no file read again, readers undisturbed."""
    handles = client.area(EVERYTHING).cells
    before, epoch = {handle.id: handle.segment for handle in handles}, client.epoch
    path = f"{served.shm_dir}{before[divided_map.id('0_0.pcd')]}"
    checksum = zlib.crc32(Path(path).read_bytes())
    with MappingProcess([path]) as reader:
        if end == "kill":
            served.kill()
            assert all(wait_ended(pid, 10.0) for pid in served.children()), "a loader outlives it"
        else:
            assert served.leave() == 0
            left = [name for name in os.listdir(served.shm_dir) if name not in served.segments()]
            assert (left, os.path.exists(served.endpoint)) == ([], False)
        assert len(served.segments()) == len(before) == 36
        assert reader.checksums() == [checksum]
        served.start()
        with pytest.raises(DaemonError, match="no_session"):
            client.area(EVERYTHING)
        client.hello()
        assert client.epoch != epoch
        again = client.area(EVERYTHING)
        assert_right(client, again, divided_map)
        assert segments_of(again) == before
        held = client.differential(EVERYTHING, packed=[handle.version for handle in handles])
        assert (held.cells, held.removed_versions) == ([], [])
        counters = client.ask("stats")[4]
        assert (counters["adopted"], counters["loads_started"], counters["adoptions_failed"]) == (36, 0, 0)
        assert counters["bytes_resident"] == served.segment_bytes()
        assert reader.checksums() == [checksum]
    assert served.stop() == 0  # a stop empties, adopted segments included
    assert served.leftovers() == []


def test_a_sigterm_after_the_announcement_of_a_restart_changes_nothing(
    served: DaemonProcess, connect: Connect
) -> None:
    """As a service manager does it: announce, then SIGTERM."""
    connect(served).area(EVERYTHING)
    before = served.segments()
    served.send(signal.SIGSTOP)  # so that both are there when it looks
    served.send(signal.SIGUSR1)
    served.send(signal.SIGTERM)
    assert served.process is not None
    process, served.process = served.process, None
    process.send_signal(signal.SIGCONT)
    assert process.wait(30) == 0
    assert served.segments() == before
    served.start()
    assert served.segments() == before


def test_a_waiting_request_is_answered_by_the_next_run(
    daemon: DaemonFactory, divided_map: DividedMap
) -> None:
    one = daemon(divided_map.root, "--workers", "1")
    with shmmap.connect(one.endpoint, timeout=60.0) as client:
        held = list(client.around(0, 0, 5).raise_for_failures())
        loads = client.stats().counters["loads_started"]
        one.stop_loaders()
        found: list[shmmap.CellSet] = []
        thread = threading.Thread(target=lambda: found.append(client.around(40, 40, 15, wait=60.0)))
        thread.start()
        waiting = Deadline()
        with shmmap.connect(one.endpoint) as watcher:
            while waiting(watcher.stats().counters["loads_started"] == loads):
                pass
        assert one.leave() == 0
        one.start()
        thread.join(60)
        assert sorted(cell.id.rsplit("/", 1)[1] for cell in found[0]) == divided_map.in_circle(40, 40, 15)
        again = list(client.around(0, 0, 5))
        assert {id(cell) for cell in again} == {id(cell) for cell in held}  # nothing was mapped again


def open_to_others(path: str) -> None:
    os.chmod(path, 0o660)


@pytest.mark.parametrize(
    "damage",
    [
        damage_payload,
        damage_header,
        other_layout,
        other_builder,
        damage_publish_block,
        shorten,
        punch,
        open_to_others,
    ],
)
def test_a_damaged_leftover_is_never_served(
    served: DaemonProcess, client: RawClient, divided_map: DividedMap, damage: Callable[[str], None]
) -> None:
    handle = client.selected(["0_0.pcd"]).cells[0]
    served.kill()
    damage(client.path(handle))
    served.start()
    client.hello()
    reply = client.selected(["0_0.pcd"])
    assert reply.cells[0].segment != handle.segment
    assert_right(client, reply, divided_map)
    served.until_segments(1, lambda: client.ask("stats"))


def test_a_damaged_leftover_is_known_until_it_is_no_longer_mapped(
    served: DaemonProcess, client: RawClient, divided_map: DividedMap
) -> None:
    handle = client.selected(["0_0.pcd"]).cells[0]
    with MappingProcess([client.path(handle)]) as reader:
        served.kill()
        damage_payload(client.path(handle))
        served.start()
        client.hello()
        reply = client.selected(["0_0.pcd"])
        assert_right(client, reply, divided_map)
        shown = client.ask("show", "0_0.pcd")[9]
        assert sorted((row[3], row[4]) for row in shown) == sorted(
            [(reply.cells[0].segment, "resident"), (handle.segment, "zombie")]
        )
        assert reader.checksums()
    served.until_segments(1, lambda: client.ask("stats"))


def test_what_changed_between_two_runs_is_loaded_again(
    served: DaemonProcess, client: RawClient, divided_map: DividedMap
) -> None:
    """Changed, removed and moved cells of the map; the old state of one is still mapped and shows."""
    before = segments_of(client.area(EVERYTHING))
    changed = divided_map.id("0_0.pcd")
    path = f"{served.shm_dir}{before[changed]}"
    checksum = zlib.crc32(Path(path).read_bytes())
    with MappingProcess([path]) as reader:
        served.kill()
        divided_map.write_cell("0_0.pcd", (0, 0), random_points(np.random.default_rng(5), (0, 0), 700))
        divided_map.remove_cell("20_20.pcd")
        divided_map.write_metadata()
        served.start()
        client.hello()
        again = client.area(EVERYTHING)
        assert_right(client, again, divided_map)
        after = segments_of(again)
        assert divided_map.id("20_20.pcd") not in after
        assert [cell for cell in after if after[cell] != before[cell]] == [changed]
        assert [(row[3], row[4]) for row in client.ask("show", changed)[9]] == [
            (after[changed], "resident"), (before[changed], "zombie"),
        ]  # fmt: skip
        assert reader.checksums() == [checksum]
    served.until_segments(35, lambda: client.ask("stats"))


def test_names_that_are_no_segments_do_not_matter(served: DaemonProcess, client: RawClient) -> None:
    """A pipe, a link to another segment, a directory: not waited for, not followed, not served."""
    handle = client.selected(["0_0.pcd"]).cells[0]
    served.kill()
    base = Path(served.shm_dir, f"shmmap.{served.instance}.")
    os.mkfifo(f"{base}{'0' * 16}")
    os.symlink(client.path(handle), f"{base}{'1' * 16}")
    os.mkdir(f"{base}{'2' * 16}")
    served.start()
    client.hello()
    assert client.selected(["0_0.pcd"]).cells[0].segment == handle.segment
    left = served.segments()
    assert left == sorted([f"shmmap.{served.instance}.{'2' * 16}", handle.segment.lstrip("/")])
    os.rmdir(f"{base}{'2' * 16}")


@pytest.mark.root
def test_a_foreign_file_under_our_name_is_refused(
    served: DaemonProcess, client: RawClient, divided_map: DividedMap
) -> None:
    """A perfect copy, but of another owner: the owner of a file can change it under its readers."""
    handle = client.selected(["0_0.pcd"]).cells[0]
    served.kill()
    copy = f"{client.path(handle)[:-16]}{'3' * 16}"
    shutil.copyfile(client.path(handle), copy)
    os.chmod(copy, 0o444)
    os.chown(copy, 65534, 65534)
    os.unlink(client.path(handle))
    served.start()
    client.hello()
    reply = client.selected(["0_0.pcd"])
    assert reply.cells[0].segment not in (handle.segment, f"/{os.path.basename(copy)}")
    assert_right(client, reply, divided_map)
    assert not os.path.exists(copy)


def test_a_smaller_budget_takes_over_what_fits(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    for name, corner in list(divided_map.corners.items()):
        divided_map.write_cell(name, corner, random_points(np.random.default_rng(9), corner, 4200))
    one = daemon(divided_map.root)
    client = connect(one)
    client.area(EVERYTHING)
    assert one.segment_bytes() > 2 << 20
    one.kill()
    one.arguments += ["--budget", "1M"]
    one.start()
    client.hello()
    assert 0 < one.segment_bytes() <= 1 << 20
    assert_right(client, client.area(circle(0, 0, 5)), divided_map)
    assert one.segment_bytes() <= 1 << 20


def test_who_holds_what_is_known_across_a_restart(served: DaemonProcess, divided_map: DividedMap) -> None:
    """A client that goes on is named: for what serves again, for what was replaced, for what left the map."""
    with shmmap.connect(served.endpoint, name="the holder") as client:
        held = {cell.id: cell for cell in client.around(0, 0, 5).raise_for_failures()}
        slot = client.welcome.session
        served.kill()
        divided_map.write_cell("0_0.pcd", (0, 0), random_points(np.random.default_rng(5), (0, 0), 700))
        divided_map.remove_cell("-20_0.pcd")
        divided_map.write_metadata()
        served.start()
        gone = divided_map.id("-20_0.pcd")
        for cell_id, state in (
            (divided_map.id("0_-20.pcd"), "resident"),
            (divided_map.id("0_0.pcd"), "zombie"),
            (gone, "zombie"),
        ):
            (segment,) = client.show(cell_id).segments
            assert (segment.segment, segment.state) == (held[cell_id].segment, state)
            assert [(h.session, h.pid, h.uid, h.client) for h in segment.holders] == [
                (slot, os.getpid(), os.getuid(), "the holder")
            ]
            assert segment.holders[0].command
        assert client.welcome.session == slot
        stats = client.stats()
        (row,) = stats.sessions
        old = [held[divided_map.id("0_0.pcd")], held[gone]]
        old_bytes = sum(os.stat(f"{served.shm_dir}{cell.segment}.zombie").st_size for cell in old)
        assert (row.superseded, row.superseded_bytes) == (2, old_bytes)
        assert row.mapped_bytes == served.segment_bytes()
        assert stats.unknown_holders == 0
        with pytest.raises(shmmap.UnknownCell):
            client.show("nowhere.pcd")


def test_a_name_that_a_foreign_file_took(
    served: DaemonProcess, client: RawClient, divided_map: DividedMap
) -> None:
    """What has to retire does so under another name; its reader and the next run are not disturbed."""
    (handle,) = client.selected(["0_0.pcd"]).cells
    place = Path(f"{served.shm_dir}{handle.segment}.zombie")
    place.mkdir()  # as another account's file in a sticky directory, it cannot be replaced
    with MappingProcess([f"{served.shm_dir}{handle.segment}"]) as reader:
        (checksum,) = reader.checksums()
        served.kill()
        corner = divided_map.corners["0_0.pcd"]
        divided_map.write_cell("0_0.pcd", corner, random_points(np.random.default_rng(9), corner, 50))
        served.start()
        client.hello()
        again = client.selected(["0_0.pcd"])
        assert_right(client, again, divided_map)
        assert client.ask("stats")[4]["zombies"] == 1
        assert reader.checksums() == [checksum]
    place.rmdir()


@pytest.mark.root
@pytest.mark.parametrize("pins", ["leases", "locks"])
def test_a_foreign_file_takes_no_budget(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap, pins: str
) -> None:
    """However much it is in use: a process that has no segment of ours open keeps none of ours."""
    environment = {"SHMMAP_TEST_PINS": pins} if pins == "locks" else {}
    one = daemon(divided_map.root, start=False, environment=environment)
    strange = Path(f"{one.shm_dir}/shmmap.{one.instance}.0123456789abcdef")
    strange.write_bytes(bytes(1 << 20))
    os.chown(strange, 12345, 12345)
    with strange.open("rb") as file:
        lock_slot(file.fileno(), 7)
        one.start()
        client = connect(one)
        assert len(client.area(EVERYTHING).cells) == 36
        counters = client.ask("stats")[4]
        assert (counters["zombies"], counters["bytes_zombie"]) == (0, 0)

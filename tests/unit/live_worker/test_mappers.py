# SPDX-License-Identifier: Apache-2.0
"""Mappers: one permanent number a name, 32 at a time, and unused numbers of scans."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from shmmap.chunks.layout import MAPPERS
from shmmap.errors import BadRequest, Busy, LiveInterrupted
from shmmap.live_worker.disk.folder import Folder
from shmmap.live_worker.disk.map_database import SCANS_AHEAD, MapDatabase
from shmmap.live_worker.disk.map_record import MapSettings
from shmmap.live_worker.mappers import APPLIED_BYTES, AppliedScans, Mappers
from tests.support.odd_files import failing

SETTINGS = MapSettings(resolution=0.1)


@pytest.fixture
def disk(tmp_path: Path) -> Folder:
    return Folder(tmp_path / "map")


@pytest.fixture
def memory() -> bytearray:
    """What outlives a worker."""
    return bytearray(APPLIED_BYTES)


@pytest.fixture
def mappers(disk: Folder, memory: bytearray) -> Mappers:
    return Mappers(MapDatabase(disk, SETTINGS), AppliedScans(memory))


def test_a_user_and_a_name_are_one_mapper(mappers: Mappers) -> None:
    first = mappers.open(1000, "front", 1)
    assert mappers.next_scan(first) == 1
    assert mappers.open(1000, "front", 2) is first
    others = [mappers.open(1000, "rear", 1), mappers.open(1001, "front", 3)]
    assert len({one.mapper.number for one in (first, *others)}) == 3


def test_only_the_last_to_open_it_maps_under_a_name(mappers: Mappers) -> None:
    number = mappers.open(1000, "front", 1).mapper.number
    assert mappers.expect(number, 1, 1).session == 1
    mappers.open(1000, "front", 2)
    with pytest.raises(BadRequest, match="another program maps as 'front'"):
        mappers.expect(number, 2, 1)
    mappers.on_disconnect(1)
    assert mappers.expect(number, 2, 2).session == 2, "the first one's end is not the second one's"
    mappers.on_disconnect(2)
    with pytest.raises(LiveInterrupted, match="no mapper 'front' is active"):
        mappers.expect(number, 2, 2)


@pytest.mark.parametrize("scan", [0, -1, 1 << 63])
def test_numbers_that_no_scan_has(mappers: Mappers, scan: int) -> None:
    number = mappers.open(1000, "front", 1).mapper.number
    with pytest.raises(BadRequest, match="numbers begin at 1"):
        mappers.expect(number, scan, 1)


def test_the_least_recent_is_replaced_and_its_late_scans_are_refused(mappers: Mappers) -> None:
    opened = [mappers.open(1000, f"m{number}", number + 1) for number in range(MAPPERS)]
    for session in (3, 1, 2):
        mappers.on_disconnect(session)
    mappers.open(1000, "m2", 40)  # used again
    mappers.on_disconnect(40)
    new = mappers.open(1000, "new", 50)
    numbers = {one.mapper.number for one in opened}
    assert new.mapper.number not in numbers, "no number is given twice"
    assert opened[0].mapper.number not in mappers.by_number, "of 0, 1 and 2 it was used first"
    with pytest.raises(BadRequest, match="does not know mapper"):
        mappers.expect(opened[0].mapper.number, 7, 1)
    mappers.open(1000, "newer", 51)
    assert opened[1].mapper.number not in mappers.by_number
    again = mappers.open(1000, "m0", 52)
    assert again.mapper.number not in numbers
    assert len(mappers.by_number) == MAPPERS


def test_where_all_are_in_use_another_is_refused(mappers: Mappers) -> None:
    opened = [mappers.open(1000, f"m{number}", 1) for number in range(MAPPERS)]
    with pytest.raises(Busy, match="32 mappers"):
        mappers.open(1000, "new", 2)
    opened[5].unsaved.add(3)
    opened[5].session = 0
    with pytest.raises(Busy, match="32 mappers"):
        mappers.open(1000, "new", 2)
    opened[5].unsaved.clear()
    assert mappers.open(1000, "new", 2).mapper.name == "new"
    assert opened[5].mapper.number not in mappers.by_number


def test_the_next_run_knows_what_is_in_the_map(disk: Folder, memory: bytearray, mappers: Mappers) -> None:
    """Up to the last scan before which none is missing, in whatever order they were applied."""
    front, rear = mappers.open(1000, "front", 1), mappers.open(1000, "rear", 2)
    for scan in (1, 2, 3, 4):
        mappers.accepted(front, scan)
    for scan, then in ((2, 0), (1, 2), (4, 2)):
        mappers.applied(front, scan)
        assert front.applied == then
    mappers.accepted(rear, 9)
    mappers.applied(rear, 9)
    later = Mappers(MapDatabase(disk, SETTINGS), AppliedScans(memory))
    assert (later.open(1000, "front", 1).applied, later.open(1000, "rear", 2).applied) == (2, 9)
    assert later.open(1000, "new", 3).applied == 0


def test_without_memory_the_record_says_what_is_in_the_map(disk: Folder, mappers: Mappers) -> None:
    front = mappers.open(1000, "front", 1)
    database = MapDatabase(disk, SETTINGS)
    database.write_record({front.mapper.number: 7})
    database.write_record(None)  # nothing new is known
    assert MapDatabase(disk, SETTINGS).record.applied == {front.mapper.number: 7}
    for record, applied in ((bytearray(APPLIED_BYTES), 7), (_noted(front.mapper.number, 12), 12)):
        later = Mappers(MapDatabase(disk, SETTINGS), AppliedScans(record))
        assert later.open(1000, "front", 1).applied == applied


def _noted(mapper: int, scan: int) -> bytearray:
    memory = bytearray(APPLIED_BYTES)
    AppliedScans(memory).note(mapper, scan, {mapper})
    return memory


def test_rows_of_forgotten_mappers_are_used_again() -> None:
    record = AppliedScans(bytearray(APPLIED_BYTES))
    known = set(range(1, MAPPERS + 1))
    for mapper in known:
        record.note(mapper, 10 * mapper, known)
    record.note(100, 7, known | {100})
    assert record.of(100) == 0, "there is no room, and nothing is lost by that"
    record.note(100, 7, (known - {5}) | {100})
    assert (record.of(100), record.of(5), record.of(6)) == (7, 0, 60)


def test_the_next_run_gives_numbers_that_no_scan_had(disk: Folder, mappers: Mappers) -> None:
    """Also when one of a previous run comes again first: of those after it nothing is known."""
    front = mappers.open(1000, "front", 1)
    for scan in range(1, 8):
        mappers.expect(front.mapper.number, scan, 1).last = scan
    later = Mappers(MapDatabase(disk, SETTINGS), AppliedScans(bytearray(APPLIED_BYTES)))
    active = later.open(1000, "front", 1)
    assert active.mapper.number == front.mapper.number
    first = later.next_scan(active)
    assert first > 7
    later.expect(active.mapper.number, 5, 1).last = 5
    assert later.next_scan(active) == first
    later.expect(active.mapper.number, first, 1).last = first
    assert later.next_scan(active) == first + 1


def test_a_mapper_goes_on_while_the_disk_is_full(
    monkeypatch: pytest.MonkeyPatch, disk: Folder, mappers: Mappers
) -> None:
    active = mappers.open(1000, "front", 1)
    number = active.mapper.number
    with monkeypatch.context() as patch:
        patch.setattr("os.fsync", failing(errno.ENOSPC))
        for scan in range(1, 3000):
            mappers.expect(number, scan, 1)
        for _ in range(2):
            with pytest.raises(OSError, match="No space"):
                mappers.open(1000, "rear", 2)
            with pytest.raises(OSError, match="No space"):
                mappers.expect(number, 2 * SCANS_AHEAD, 1)
        assert [one.mapper.name for one in mappers.by_number.values()] == ["front"]
    mappers.expect(number, 2 * SCANS_AHEAD, 1)
    rear = mappers.open(1000, "rear", 2)
    found = MapDatabase(disk, SETTINGS).record.mappers
    assert [(one.number, one.name) for one in found] == [(number, "front"), (rear.mapper.number, "rear")]
    assert found[0].scans > 2 * SCANS_AHEAD


def test_a_mapper_that_cannot_be_forgotten_stays(
    monkeypatch: pytest.MonkeyPatch, disk: Folder, mappers: Mappers
) -> None:
    for number in range(MAPPERS):
        mappers.open(1000, f"m{number}", 0)
    with monkeypatch.context() as patch:
        patch.setattr("os.fsync", failing(errno.EIO))
        for _ in range(2):
            with pytest.raises(OSError, match="Input/output"):
                mappers.open(1000, "new", 1)
        assert len(mappers.by_number) == MAPPERS
    mappers.open(1000, "new", 1)
    assert [one.name for one in MapDatabase(disk, SETTINGS).record.mappers] == [
        *(f"m{number}" for number in range(1, MAPPERS)), "new",
    ]  # fmt: skip

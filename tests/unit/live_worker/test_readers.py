# SPDX-License-Identifier: Apache-2.0
"""Which chunks there are: page by page, what changed and what left; and lists of voxels by turns."""

from __future__ import annotations

import errno
import math
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shmmap.chunks.layout import HEADER_BYTES, new_header
from shmmap.chunks.voxels import ChunkKey
from shmmap.errors import BadRequest, OverBudget
from shmmap.live_worker import changes, readers, voxel_lists
from shmmap.live_worker.areas import check_area, inside, key_range, touches
from shmmap.live_worker.disk.map_record import Row
from shmmap.live_worker.paging.durability import Scan
from shmmap.live_worker.voxel_lists import KEPT_S, VOXEL_BYTES, Later, VoxelLists
from shmmap.protocol import live as messages
from shmmap.protocol.areas import BoxMessage, LiveArea, SphereMessage
from shmmap.protocol.codec import decode_reply, encode
from shmmap.protocol.live import (
    MAX_CHUNK_ROWS,
    LiveChunkPage,
    LiveChunks,
    LiveVoxels,
    LiveVoxelsReply,
)
from shmmap.protocol.messages import ErrorReply
from tests.support.calls import counted_calls
from tests.support.live_drive import RESOLUTION
from tests.support.odd_files import failing
from tests.support.served_map import Served


@pytest.fixture
def served(serve: Callable[..., Served]) -> Served:
    return serve()


def bring(served: Served, key: ChunkKey, generation: int = 1) -> None:
    """Put a new chunk into memory."""
    content = new_header(served.paged.identity(key, generation))
    served.paged.add_chunk(served.paged.memory.create(content), 0.0)


def page(served: Served, **asked: object) -> LiveChunkPage:
    """Ask for a page, and have readers go on until it is there."""
    ticket = served.ask(lambda n: LiveChunks(n, "lidar", **asked))  # type: ignore[arg-type]
    while ticket not in served.answers:
        served.map.readers.run_turn(served.now_s)
    found: LiveChunkPage = served.answers[ticket]
    return found


def on_disk(served: Served, key: ChunkKey, row: Row) -> None:
    """As if a chunk had a file."""
    served.paged.database.rows[key] = row
    served.paged.stored.add(key)


def keys_of(found: LiveChunkPage) -> list[ChunkKey]:
    return [ChunkKey(*row.key) for row in found.rows]


def test_more_chunks_than_go_into_one_answer(served: Served) -> None:
    there = [ChunkKey(x, -x % 7, 0) for x in range(-1300, 1300)]
    for key in there:
        on_disk(served, key, Row(1, 100, 5, 3, 2, 1))
    bring(served, there[5])
    found: list[ChunkKey] = []
    after, pages = None, 0
    while True:
        one = page(served, saved=True, after=after)
        assert len(one.rows) <= MAX_CHUNK_ROWS
        assert decode_reply(encode(one)) == one
        found += keys_of(one)
        pages += 1
        if not one.more:
            break
        after = one.rows[-1].key
    assert found == sorted(there)
    assert pages == 3
    assert keys_of(page(served)) == [there[5]]


def test_what_changed_and_what_left(served: Served) -> None:
    a, b, c = (ChunkKey(x, 0, 0) for x in range(3))
    for key in (a, b, c):
        bring(served, key)
    everything = page(served)
    assert keys_of(everything) == [a, b, c]
    assert everything.since_known
    assert keys_of(page(served, since=everything.change)) == []
    for key in (b, a, b):
        served.paged.changes.note_changed(key)
    chunk = served.paged.chunks.pop(c)
    served.paged.residency._forget(c)
    served.paged.changes.note_gone(c)
    later = page(served, since=everything.change)
    assert (keys_of(later), later.gone, later.since_known) == ([a, b], (c,), True)
    second = page(served, since=everything.change, after=tuple(a))
    assert (keys_of(second), second.gone) == ([b], ()), "they were on the first page"
    elsewhere = BoxMessage(-100.0, -100.0, -90.0, -90.0)
    assert page(served, since=everything.change, area=elsewhere).gone == ()
    unknown = page(served, since=later.change + 5)
    assert (keys_of(unknown), unknown.gone, unknown.since_known) == ([a, b], (), False)
    served.paged.chunks[c] = chunk  # it is closed with the others


def test_the_longest_answer_is_shorter_than_a_packet_may_be(served: Served) -> None:
    """As many rows and as many gone chunks as there may be, with the longest numbers."""
    served.paged.changes.note_changed(ChunkKey(0, 0, 0))
    since = served.paged.changes.number
    for x in range(20_000):
        served.paged.changes.note_gone(ChunkKey(-(1 << 24) + x, -(1 << 24), -(1 << 24)))
    row = Row(1 << 62, 1 << 40, 1 << 18, 1 << 18, 1 << 18, 1)
    for x in range(MAX_CHUNK_ROWS):
        on_disk(served, ChunkKey(-(1 << 24) + x, 0, -(1 << 24)), row)
    assert not page(served, since=since).since_known
    first = served.paged.changes._gone[0][0]
    found = page(served, since=first, saved=True)
    assert found.since_known
    assert len(found.rows) == MAX_CHUNK_ROWS
    assert len(encode(found)) < 180_000, "a socket takes 212 992 bytes unless that limit was raised"


def test_chunks_that_are_being_loaded_are_listed(served: Served) -> None:
    """But not to a client that asks what changed: it cannot read them yet."""
    there, coming = ChunkKey(2, 0, 0), ChunkKey(3, 0, 0)
    paged = served.paged
    bring(served, there, 2)
    before = served.paged.changes.number
    paged.residency.add(Scan(1, 1, 10, {coming}))
    assert paged.residency.begin_load(0.0) is not None
    found = {ChunkKey(*row.key): (row.state, row.generation, row.bytes) for row in page(served).rows}
    assert found == {there: ("clean", 2, HEADER_BYTES), coming: ("loading", 0, HEADER_BYTES)}
    assert not page(served, since=before).rows


def test_areas_and_kinds_that_make_no_sense(served: Served) -> None:
    backwards = BoxMessage(1.0, 0.0, 0.0, 1.0)
    with pytest.raises(BadRequest, match="area"):
        page(served, area=backwards)
    for wrong, said in (
        (messages.LiveVoxels(1, "lidar", area=backwards), "area"),
        (messages.LiveVoxels(1, "lidar", scope="moon"), "scope"),
        (messages.LiveVoxels(1, "lidar", kind="full"), "not 'full'"),
    ):
        with pytest.raises(BadRequest, match=said):
            served.ask(lambda _n, wrong=wrong: wrong)  # type: ignore[misc]


def test_chunks_are_listed_while_others_are_saved(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files are written in other threads."""
    row = Row(1, 100, 0, 0, 0, 1)
    for x in range(3):
        on_disk(served, ChunkKey(x, 0, 0), row)

    def touch_and_save(_area: object, key: ChunkKey, _resolution: float) -> bool:
        served.paged.database.rows[ChunkKey(key.x, 50, 50)] = row
        return True

    monkeypatch.setattr(readers, "touches", touch_and_save)
    assert keys_of(page(served, saved=True)) == [ChunkKey(x, 0, 0) for x in range(3)]
    del served.paged.database.rows[ChunkKey(1, 0, 0)]
    assert keys_of(page(served, saved=True)) == [ChunkKey(x, 0, 0) for x in (0, 2)], "one was quarantined"


def test_lists_of_several_readers_are_made_by_turns(served: Served) -> None:
    for x in range(40):
        bring(served, ChunkKey(x, 0, 0))
    long = served.ask(lambda n: messages.LiveVoxels(n, "lidar"))
    corner = BoxMessage(0.0, 0.0, 1.0, 1.0)
    short = served.ask(lambda n: messages.LiveVoxels(n, "lidar", area=corner), session=2)
    gone = served.ask(lambda n: messages.LiveVoxels(n, "lidar"), session=3)
    assert served.map.next_turn_s(served.now_s) == served.now_s
    served.map.on_disconnect(3)
    while not {short, long} <= served.answers.keys():
        served.map.readers.run_turn(served.now_s)
    assert list(served.answers) == [short, long]
    assert gone not in served.answers
    assert not isinstance(served.answers[long], ErrorReply)


def test_a_session_that_asks_for_much_waits_for_one_that_asks_for_little(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A step each by turns, however many requests one of them has."""
    monkeypatch.setattr(readers, "BURST_S", 0.0)  # a step a turn
    for x in range(1000):
        on_disk(served, ChunkKey(x, 0, 0), Row(1, 100, 0, 0, 0, 1))
    for _ in range(64):
        served.ask(lambda n: LiveChunks(n, "lidar", saved=True), session=1)
    few = served.ask(lambda n: LiveChunks(n, "lidar"), session=2)
    turns = 0
    while few not in served.answers:
        served.map.readers.run_turn(served.now_s)
        turns += 1
    assert turns <= 4
    assert list(served.answers) == [few]


IN_A_CORNER = BoxMessage(10.0, 0.0, 20.0, 5.0)


@pytest.mark.parametrize(
    ("asked", "most_in_all"),
    [
        ({"saved": True}, 10_000),
        ({}, 10_000),
        ({"saved": True, "area": IN_A_CORNER}, 500),
        ({"saved": True, "area": SphereMessage(15.0, 0.0, 0.0, 5.0)}, 500),
        ({"saved": True, "after": (19, 50, 0)}, 3_000),
        ({"since": 0}, 200),
    ],
)
def test_a_turn_is_short_and_what_is_asked_for_is_found_by_an_index(
    served: Served, monkeypatch: pytest.MonkeyPatch, asked: dict[str, Any], most_in_all: int
) -> None:
    """However many chunks there are, beyond an area, before the page, and that did not change."""
    monkeypatch.setattr(readers, "BURST_S", 0.0)
    for x in range(20):
        for y in range(100):
            on_disk(served, ChunkKey(x, y, 0), Row(1, 100, 0, 0, 0, 1))
    for x in range(200):
        bring(served, ChunkKey(x, -x, 0))
    if "since" in asked:
        asked = {"since": served.paged.changes.number}
    for x in (7, 3, 7):
        served.paged.changes.note_changed(ChunkKey(x, -x, 0))
    ticket = served.ask(lambda n: LiveChunks(n, "lidar", **asked))
    turns = []
    while ticket not in served.answers:
        with counted_calls() as calls:
            served.map.readers.run_turn(served.now_s)
        turns.append(calls.count)
    if "since" in asked:
        assert keys_of(served.answers[ticket]) == [ChunkKey(3, -3, 0), ChunkKey(7, -7, 0)]
    assert max(turns) <= 1_000
    assert sum(turns) <= most_in_all


def test_a_reader_of_a_slow_disk_keeps_no_other_waiting(served: Served, tmp_path: Path) -> None:
    """Not those of its own session in memory, not other sessions, not the map."""
    for x in range(3):
        on_disk(served, ChunkKey(x, 0, 0), Row(1, 100, 0, 0, 0, 1))
    bring(served, ChunkKey(9, 0, 0))
    goes_on = threading.Event()

    def slow(_key: ChunkKey) -> None:
        goes_on.wait()

    served.paged.database.load = slow  # type: ignore[method-assign, assignment]
    try:
        waits = [served.ask(lambda n: messages.LiveVoxels(n, "lidar", scope="disk")) for _ in range(3)]
        left = served.ask(lambda n: messages.LiveVoxels(n, "lidar", scope="disk"), session=3)
        for session in (1, 2):
            assert served.answer(served.ask(lambda n: messages.LiveVoxels(n, "lidar"), session)).count == 0
        served.map.on_disconnect(3)
        assert not served.answers.keys() & {*waits, left}
        assert served.map.readers.next_turn_s(served.now_s) > served.now_s, "no turn in vain"
    finally:
        goes_on.set()
    for ticket in waits:
        assert served.answer(ticket).count == 0
    served.turn()
    assert left not in served.answers


def test_the_end_waits_for_no_reader_s_files(served: Served) -> None:
    """Of all that were asked for, at most those that are being read just now are read."""
    for x in range(100):
        on_disk(served, ChunkKey(x, 0, 0), Row(1, 100, 0, 0, 0, 1))
    begun, goes_on, read = threading.Event(), threading.Event(), []

    def slow(key: ChunkKey, generation: int = 0) -> bytearray | None:
        read.append((key, generation))
        begun.set()
        goes_on.wait()
        return None

    served.paged.database.load = slow  # type: ignore[method-assign]
    try:
        for session in range(1, 9):
            served.ask(lambda n: messages.LiveVoxels(n, "lidar", scope="disk"), session)
        while not begun.is_set():
            served.turn()
        served.map.readers.close()
    finally:
        goes_on.set()
    for thread in served.map.readers._threads._threads._threads:
        thread.join()
    assert len(read) <= readers.THREADS


def test_the_busiest_readers_are_named(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    for x in range(500):
        on_disk(served, ChunkKey(x, 0, 0), Row(1, 100, 0, 0, 0, 1))
    for _ in range(20):
        page(served, saved=True)
    served.ask(lambda n: LiveChunks(n, "lidar"), session=2)
    served.turn()
    end_s = time.monotonic() + readers.MEASURED_S
    served.map.readers.measure(end_s)
    (first, much), (second, little) = served.map.readers.busiest
    assert (first, second) == (1, 2)
    assert much > little
    assert served.map.status().readers == served.map.readers.busiest
    served.map.readers.measure(end_s + readers.MEASURED_S)
    assert served.map.readers.busiest == ()


def test_not_all_that_left_is_remembered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(changes, "MAX_GONE", 3)
    one = changes.Changes(100)
    one.note_gone(ChunkKey(0, 0, 0))
    assert [since for since in range(98, 104) if one.known(since)] == [100, 101], "neither of another run"
    for x in range(1, 5):
        one.note_gone(ChunkKey(x, 0, 0))
    assert [since for since in range(98, 110) if one.known(since)] == [102, 103, 104, 105]
    assert one.gone(102) == [ChunkKey(x, 0, 0) for x in (2, 3, 4)]
    assert len(one.gone(100)) == 3


# --- lists of voxels ----------------------------------------------------------------------------

INF, NAN = float("inf"), float("nan")
VOXELS = 256
KEYS = [ChunkKey(x, 0, 0) for x in range(20)]


def names(shm: Path) -> list[str]:
    return sorted(name for name in os.listdir(shm) if ".voxels." in name)


@pytest.fixture
def filled(serve: Callable[..., Served]) -> Served:
    """20 chunks in memory, of 256 occupied voxels each; lists may take a quarter of a million bytes."""
    one = serve(10**6)
    for key in KEYS:
        file = one.paged.memory.create(new_header(one.paged.identity(key, 1)))
        view = file.grow(1)
        view.bricks[0] = 100
        view.index[0] = 1
        view.state["bricks"] = view.state["version"] = 1
        view.state["active"] = view.state["occupied"] = VOXELS
        one.paged.add_chunk(file, 0.0)
    return one


@pytest.fixture
def lists(filled: Served) -> VoxelLists:
    return filled.map.readers.lists


def collect(
    lists: VoxelLists, keys: list[ChunkKey], session: int = 1, kind: str = "occupied", scope: str = "memory",
    area: LiveArea | None = None,
) -> LiveVoxelsReply:  # fmt: skip
    """Make a list, all steps at once; what a thread is to do is done here."""
    steps = lists.collect(LiveVoxels(1, "lidar", kind, area, scope), iter([keys]), session, 5)
    outcome = None
    while True:
        try:
            step = steps.send(outcome)
        except StopIteration as done:
            reply: LiveVoxelsReply = done.value
            return reply
        outcome = step() if callable(step) else None


@pytest.mark.parametrize(
    "area",
    [
        SphereMessage(NAN, 0, 0, 1), SphereMessage(0, 0, 0, INF), SphereMessage(0, 0, 0, -1),
        SphereMessage(0, 0, 0, 1.4e154), SphereMessage(0, 0, 0, 1.7e308), SphereMessage(0, 0, 0, NAN),
        SphereMessage(1e155, 0, 0, 1), SphereMessage(0, 0, -1.7e308, 1), SphereMessage(-INF, 0, 0, 1),
        BoxMessage(1, 0, 0, 1), BoxMessage(0, 1, 1, 0), BoxMessage(0, 0, INF, 1), BoxMessage(0, NAN, 1, 1),
        BoxMessage(0, 0, 1, 1, 2.0, 1.0), BoxMessage(0, 0, 1, 1, 2.0, None),
        BoxMessage(0, 0, 1, 1, None, 2.0),
        BoxMessage(0, 0, 1, 1, NAN, 2.0),
    ],
)  # fmt: skip
def test_areas_that_make_no_sense(area: LiveArea) -> None:
    with pytest.raises(BadRequest, match="area"):
        check_area(area)


@pytest.mark.parametrize("resolution", [1e-4, 0.2, 1e3])
@pytest.mark.parametrize(
    "area",
    [
        BoxMessage(-1.7e308, -1.7e308, 1.7e308, 1.7e308), BoxMessage(0, 0, 1, 1, -1.7e308, 1.7e308),
        SphereMessage(0, 0, 0, 9e149), SphereMessage(9e149, -9e149, 9e149, 9e149),
        SphereMessage(5e-324, 0, 0, 5e-324),
    ],
)  # fmt: skip
def test_the_largest_areas_that_make_sense(area: LiveArea, resolution: float) -> None:
    """Whatever their numbers come to, squared or divided by a small voxel."""
    check_area(area)
    low, high = key_range(area, resolution)
    assert all(a < b for a, b in zip(low, high, strict=True))
    with np.errstate(all="raise", under="ignore"):
        touches(area, ChunkKey(3, -1, 0), resolution)
        inside(area, np.array([[1.0, 2.0, 3.0]]))


AREAS: list[LiveArea] = [
    SphereMessage(0, 0, 0, 0), SphereMessage(-3.0, 20.0, 1.0, 14.0), SphereMessage(1e6, 0, 0, 10.0),
    BoxMessage(-1.0, -1.0, 1.0, 1.0), BoxMessage(-30.0, 3.0, 14.0, 3.2), BoxMessage(0, 0, 5, 5, -2.0, 2.0),
    BoxMessage(0, 0, 5, 5, 13.0, 40.0),
]  # fmt: skip


@pytest.mark.parametrize("area", AREAS)
def test_a_chunk_is_looked_into_if_any_of_its_voxels_lies_in_the_area(area: LiveArea) -> None:
    check_area(area)
    steps = (np.arange(64) + 0.5) * RESOLUTION
    centres = np.stack(np.meshgrid(steps, steps, steps[::4], indexing="ij"), -1).reshape(-1, 3)
    for x in range(-3, 4):
        for y in range(-3, 4):
            for z in (-1, 0, 1):
                key = ChunkKey(x, y, z)
                if inside(area, centres + key.box(RESOLUTION)[:3]).any():
                    assert touches(area, key, RESOLUTION), key
                    low_key, high_key = key_range(area, RESOLUTION)
                    assert all(a <= b <= c for a, b, c in zip(low_key, key, high_key, strict=True)), key
    far = ChunkKey(1000, -1000, 0)
    assert not touches(area, far, RESOLUTION)
    assert touches(None, far, RESOLUTION)


def test_a_list_says_which_voxels_there_are(filled: Served, lists: VoxelLists, shm: Path) -> None:
    area = BoxMessage(0.0, 0.0, 0.45, 10.0)  # two voxels along x
    reply = collect(lists, KEYS[:2], area=area)
    assert (reply.request, reply.change, reply.count) == (1, 5, 2 * 8 * 4)
    data = (shm / reply.segment[1:]).read_bytes()
    assert len(data) == reply.bytes == VOXEL_BYTES * reply.count
    indices = np.frombuffer(data, "<i4", 3 * reply.count).reshape(-1, 3)
    assert set(indices[:, 0].tolist()) == {0, 1}
    assert (np.frombuffer(data, "<i2", reply.count, 12 * reply.count) == 100).all()
    assert (shm / reply.segment[1:]).stat().st_mode & 0o777 == 0o600
    assert collect(lists, KEYS, kind="free").count == 0
    assert collect(lists, [ChunkKey(9, 9, 9)]).count == 0


def test_more_than_fits_is_refused_and_what_was_made_is_forgotten(lists: VoxelLists, shm: Path) -> None:
    most = 10**6 // voxel_lists.PART_OF_BUDGET // VOXEL_BYTES // VOXELS  # chunks
    many = [KEYS[0]] * (most + 1)
    with pytest.raises(OverBudget, match="all lists together may take 250000 bytes"):
        collect(lists, many)
    assert (lists.nbytes, names(shm)) == (0, [])
    collect(lists, many[:20])
    with pytest.raises(OverBudget):
        collect(lists, many[1:], session=2)


def test_lists_that_are_being_made_count_as_well(lists: VoxelLists) -> None:
    """Else a reader that asks for many at a time has as much memory taken as it likes."""
    message = LiveVoxels(1, "lidar")
    works = [lists.collect(message, iter([[KEYS[0]] * 40]), session, 0) for session in (1, 2)]

    def go_on() -> None:
        while True:
            for work in works:
                assert next(work) is None

    with pytest.raises(OverBudget):
        go_on()
    for work in works:
        work.close()
    collect(lists, [KEYS[0]] * 60)


def test_a_list_waits_until_chunks_have_made_room(filled: Served, lists: VoxelLists) -> None:
    """And takes no byte before: it is within the budget as they are."""
    residency = filled.paged.residency
    residency.beside_bytes = residency.limits.budget_bytes - residency.chunk_bytes
    steps = lists.collect(LiveVoxels(1, "lidar"), iter([KEYS[:1]]), 1, 0)
    while not isinstance(next(steps), Later):
        pass
    assert (lists.asked_bytes, lists.nbytes) == (4096, 0)
    residency.beside_bytes -= 4096
    with pytest.raises(StopIteration):
        next(steps)
    assert (lists.asked_bytes, lists.nbytes) == (0, 4096)
    assert residency.beside_bytes + residency.chunk_bytes == residency.limits.budget_bytes
    lists.on_disconnect(1)
    assert residency.beside_bytes + residency.chunk_bytes == residency.limits.budget_bytes - 4096


@pytest.mark.parametrize("how", ["released", "expired", "left"])
def test_a_list_is_cut_when_it_was_read_or_was_there_for_long(lists: VoxelLists, shm: Path, how: str) -> None:
    """Whatever its reader has open: else it could keep as much memory as it likes."""
    reply = collect(lists, KEYS)
    with (shm / reply.segment[1:]).open("rb") as file:
        assert os.fstat(file.fileno()).st_blocks * 512 == lists.nbytes > reply.bytes
        begun_s = time.monotonic()
        lists.expire(begun_s)
        assert begun_s < lists.next_expiry_s <= time.monotonic() + KEPT_S
        if how == "released":
            lists.release(1, reply.segment)
        elif how == "expired":
            lists.expire(time.monotonic() + KEPT_S)
        else:
            lists.on_disconnect(1)
        assert os.fstat(file.fileno()).st_blocks == 0
        assert file.read() == b""
    assert (lists.nbytes, lists.paged.residency.beside_bytes, names(shm)) == (0, 0, [])
    assert lists.next_expiry_s == math.inf


def test_a_session_s_oldest_lists_are_removed(lists: VoxelLists, shm: Path) -> None:
    made = [collect(lists, KEYS[:1]).segment[1:] for _ in range(voxel_lists.LISTS_PER_SESSION + 2)]
    other = collect(lists, KEYS[:1], session=2).segment
    assert names(shm) == sorted([*made[2:], other[1:]])
    lists.release(1, other)
    lists.release(1, "/nothing")
    assert other[1:] in names(shm), "it is not that session's"
    lists.release(1, "/" + made[3])
    assert made[3] not in names(shm)
    lists.on_disconnect(1)
    assert names(shm) == [other[1:]]
    lists.on_disconnect(2)
    assert (lists.nbytes, names(shm)) == (0, [])


def test_where_there_is_no_memory_no_name_stays(
    monkeypatch: pytest.MonkeyPatch, lists: VoxelLists, shm: Path
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(os, "fchmod", failing(errno.ENOSPC))
        with pytest.raises(OSError, match="No space"):
            collect(lists, KEYS)
    assert (lists.nbytes, names(shm)) == (0, [])


def test_lists_of_an_previous_run_are_removed(lists: VoxelLists, shm: Path) -> None:
    name = collect(lists, KEYS[:1]).segment[1:]
    other = name.replace(".lidar.", ".radar.")
    (shm / other).touch()
    VoxelLists(lists.paged).remove_all()
    assert names(shm) == [other]
    (shm / other).unlink()


@pytest.mark.parametrize("scope", ["disk", "all"])
def test_the_disk_is_read_in_threads(filled: Served, lists: VoxelLists, scope: str) -> None:
    """Some files at a time, and never by the worker itself."""
    filled.until(lambda: filled.paged.all_durable, save_all=True)
    if scope == "all":
        for key in KEYS[5:]:
            del filled.paged.residency.chunks[key]
            filled.paged.memory.give_up(filled.paged.chunks.pop(key))
    load, where = filled.paged.database.load, []

    def noted(key: ChunkKey, generation: int = 0) -> bytearray | None:
        where.append(threading.get_ident())
        return load(key, generation)

    filled.paged.database.load = noted  # type: ignore[method-assign]
    ticket = filled.ask(lambda n: LiveVoxels(n, "lidar", scope=scope))
    reply = filled.answer(ticket)
    assert reply.count == VOXELS * len(KEYS)
    assert len(where) == len(KEYS[5:] if scope == "all" else KEYS)
    assert threading.get_ident() not in where


def test_a_file_that_cannot_be_read_is_an_error_of_the_one_request(filled: Served) -> None:
    filled.until(lambda: filled.paged.all_durable, save_all=True)
    filled.paged.database.load = failing(errno.EIO)  # type: ignore[method-assign]
    failed = filled.answer(filled.ask(lambda n: LiveVoxels(n, "lidar", scope="disk")))
    assert (failed.code, "Input/output error" in failed.message) == ("bad_map_data", True)
    assert filled.answer(filled.ask(lambda n: LiveVoxels(n, "lidar"))).count == VOXELS * len(KEYS)

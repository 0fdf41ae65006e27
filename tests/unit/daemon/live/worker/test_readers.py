# SPDX-License-Identifier: Apache-2.0
"""Which chunks there are: page by page, what changed and what left; and lists of voxels by turns."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from shmmap.chunks.layout import HEADER_BYTES, new_header
from shmmap.chunks.voxels import ChunkKey
from shmmap.daemon.live.disk.map_record import Row
from shmmap.daemon.live.paging.durability import Scan
from shmmap.daemon.live.worker import areas, readers
from shmmap.errors import BadRequest
from shmmap.protocol import live as messages
from shmmap.protocol.areas import BoxMessage
from shmmap.protocol.codec import decode_reply, encode
from shmmap.protocol.live import MAX_CHUNK_ROWS, LiveChunkPage, LiveChunks, SphereMessage
from shmmap.protocol.messages import ErrorReply
from tests.support.served_map import Served


@pytest.fixture
def served(serve: Callable[..., Served]) -> Served:
    return serve()


def bring(served: Served, key: ChunkKey, generation: int = 1) -> None:
    """Put a new chunk into memory."""
    content = new_header(served.live.identity(key, generation))
    served.live.add_chunk(served.live.memory.create(content), 0.0)


def page(served: Served, **asked: object) -> LiveChunkPage:
    """Ask for a page, and have readers go on until it is there."""
    ticket = served.ask(lambda n: LiveChunks(n, "lidar", **asked))  # type: ignore[arg-type]
    while ticket not in served.answers:
        served.map.readers.run_turn(served.now_s)
    found: LiveChunkPage = served.answers[ticket]
    return found


def on_disk(served: Served, key: ChunkKey, row: Row) -> None:
    """As if a chunk had a file."""
    served.live.files.rows[key] = row
    served.live.stored.add(key)


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
    served.map.changes.note_changed(b)
    chunk = served.live.chunks.pop(c)
    served.live.residency._forget(c)
    served.map.changes.note_gone(c)
    later = page(served, since=everything.change)
    assert (keys_of(later), later.gone, later.since_known) == ([b], (c,), True)
    assert page(served, since=everything.change, after=tuple(a)).gone == (), "they were on the first page"
    elsewhere = BoxMessage(-100.0, -100.0, -90.0, -90.0)
    assert page(served, since=everything.change, area=elsewhere).gone == ()
    unknown = page(served, since=later.change + 5)
    assert (keys_of(unknown), unknown.gone, unknown.since_known) == ([a, b], (), False)
    served.live.chunks[c] = chunk  # it is closed with the others


def test_the_longest_answer_is_shorter_than_a_packet_may_be(served: Served) -> None:
    """So many rows, so many that left, and all numbers as long as they get."""
    served.map.changes.note_changed(ChunkKey(0, 0, 0))
    since = served.map.changes.number
    for x in range(20_000):
        served.map.changes.note_gone(ChunkKey(-(1 << 24) + x, -(1 << 24), -(1 << 24)))
    row = Row(1 << 62, 1 << 40, 1 << 18, 1 << 18, 1 << 18, 1)
    for x in range(MAX_CHUNK_ROWS):
        on_disk(served, ChunkKey(-(1 << 24) + x, 0, -(1 << 24)), row)
    assert not page(served, since=since).since_known
    first = served.map.changes._gone[0][0]
    found = page(served, since=first, saved=True)
    assert found.since_known
    assert len(found.rows) == MAX_CHUNK_ROWS
    assert len(encode(found)) < 180_000, "a socket takes 212 992 bytes where nobody has raised that"


def test_chunks_on_their_way_in_are_listed(served: Served) -> None:
    """But not to a client that asks what changed: it cannot read them yet."""
    there, coming = ChunkKey(2, 0, 0), ChunkKey(3, 0, 0)
    live = served.live
    bring(served, there, 2)
    before = served.map.changes.number
    live.residency.add(Scan(1, 1, 10, {coming}))
    assert live.residency.next_load(0.0) is not None
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
        served.live.files.rows[ChunkKey(key.x, 50, 50)] = row
        return True

    monkeypatch.setattr(readers, "touches", touch_and_save)
    assert keys_of(page(served, saved=True)) == [ChunkKey(x, 0, 0) for x in range(3)]


def test_a_file_that_was_quarantined_is_listed_no_more(served: Served) -> None:
    keys = [ChunkKey(x, 0, 0) for x in range(3)]
    for key in keys:
        on_disk(served, key, Row(1, 100, 0, 0, 0, 1))
    del served.live.files.rows[keys[1]]
    assert keys_of(page(served, saved=True)) == [keys[0], keys[2]]


def test_lists_of_several_readers_are_made_by_turns(served: Served) -> None:
    for x in range(40):
        bring(served, ChunkKey(x, 0, 0))
    long = served.ask(lambda n: messages.LiveVoxels(n, "lidar"))
    corner = BoxMessage(0.0, 0.0, 1.0, 1.0)
    short = served.ask(lambda n: messages.LiveVoxels(n, "lidar", area=corner), session=2)
    gone = served.ask(lambda n: messages.LiveVoxels(n, "lidar"), session=3)
    assert served.map.next_turn_s(served.now_s) == served.now_s
    served.map.on_disconnect(3)
    while served.map.readers.are_waiting:
        served.map.readers.run_turn(served.now_s)
    assert list(served.answers) == [short, long]
    assert gone not in served.answers
    assert not isinstance(served.answers[long], ErrorReply)


def test_a_session_that_asks_for_much_waits_for_one_that_asks_for_little(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A step each by turns, however many requests one of them has."""
    monkeypatch.setattr(readers, "TURN_S", 0.0)  # a step a turn
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


@pytest.mark.parametrize("area", [None, BoxMessage(10.0, 0.0, 20.0, 5.0), SphereMessage(15.0, 0.0, 0.0, 5.0)])
@pytest.mark.parametrize("saved", [True, False])
def test_a_step_looks_at_few_chunks_however_many_there_are(
    served: Served, monkeypatch: pytest.MonkeyPatch, area: messages.LiveArea | None, *, saved: bool
) -> None:
    monkeypatch.setattr(readers, "TURN_S", 0.0)
    for x in range(20):
        for y in range(100):
            on_disk(served, ChunkKey(x, y, 0), Row(1, 100, 0, 0, 0, 1))
    bring(served, ChunkKey(1, 0, 0))
    looked = 0

    def counted(area: messages.LiveArea | None, key: ChunkKey, resolution: float) -> bool:
        nonlocal looked
        looked += 1
        return areas.touches(area, key, resolution)

    monkeypatch.setattr(readers, "touches", counted)
    ticket = served.ask(lambda n: LiveChunks(n, "lidar", area, saved=saved))
    most = 0
    while ticket not in served.answers:
        before = looked
        served.map.readers.run_turn(served.now_s)
        most = max(most, looked - before)
    assert most <= 2 * readers.KEYS_PER_STEP
    if area is not None:
        assert looked < 60, "an area is found by the index"


def test_the_next_page_begins_where_the_last_one_ended(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It does not look at those before again."""
    for x in range(3000):
        on_disk(served, ChunkKey(x, 0, 0), Row(1, 100, 0, 0, 0, 1))
    looked: list[ChunkKey] = []

    def touched(_area: object, key: ChunkKey, _resolution: float) -> bool:
        looked.append(key)
        return True

    monkeypatch.setattr(readers, "touches", touched)
    page(served, saved=True, after=(1990, 0, 0))
    assert looked[0] == (1991, 0, 0)
    assert len(looked) <= MAX_CHUNK_ROWS + readers.KEYS_PER_STEP + 9


def test_what_changed_is_found_without_a_look_at_what_did_not(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Readers ask that with each look at voxels."""
    keys = [ChunkKey(x, 0, 0) for x in range(300)]
    for key in keys:
        bring(served, key)
    since = served.map.changes.number
    for key in (keys[7], keys[3], keys[7]):
        served.map.changes.note_changed(key)
    monkeypatch.setattr(readers, "merged_part", lambda *_: pytest.fail("all are looked at"))
    assert keys_of(page(served, since=since)) == [keys[3], keys[7]]
    assert keys_of(page(served, since=since, after=tuple(keys[3]))) == [keys[7]]


def test_a_reader_of_a_slow_disk_keeps_no_other_waiting(served: Served, tmp_path: Path) -> None:
    """Not those of its own session in memory, not other sessions, not the map."""
    for x in range(3):
        on_disk(served, ChunkKey(x, 0, 0), Row(1, 100, 0, 0, 0, 1))
    bring(served, ChunkKey(9, 0, 0))
    goes_on = threading.Event()

    def slow(_key: ChunkKey) -> None:
        goes_on.wait()

    served.live.files.load = slow  # type: ignore[method-assign, assignment]
    try:
        waits = [served.ask(lambda n: messages.LiveVoxels(n, "lidar", scope="disk")) for _ in range(3)]
        left = served.ask(lambda n: messages.LiveVoxels(n, "lidar", scope="disk"), session=3)
        for session in (1, 2):
            assert served.answer(served.ask(lambda n: messages.LiveVoxels(n, "lidar"), session)).count == 0
        served.map.on_disconnect(3)
        assert not served.answers.keys() & {*waits, left}
        assert served.map.readers.next_turn_s(served.now_s) > served.now_s, "nobody turns in vain"
    finally:
        goes_on.set()
    for ticket in waits:
        assert served.answer(ticket).count == 0
    served.turn()
    assert left not in served.answers


def test_the_end_waits_for_no_reader_s_files(served: Served) -> None:
    """Of so many that were asked for, at most those that are being read just now are read."""
    for x in range(100):
        on_disk(served, ChunkKey(x, 0, 0), Row(1, 100, 0, 0, 0, 1))
    begun, goes_on, read = threading.Event(), threading.Event(), []

    def slow(key: ChunkKey) -> None:
        read.append(key)
        begun.set()
        goes_on.wait()

    served.live.files.load = slow  # type: ignore[method-assign]
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


def test_what_is_known() -> None:
    one = readers.Changes(100)
    one.note_changed(ChunkKey(0, 0, 0))
    assert one.known(100)
    assert one.known(101)
    assert not one.known(99), "that was a previous run"
    assert not one.known(102), "that was another worker's, after which the clock was set back"


def test_not_all_that_left_is_remembered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(readers, "MAX_GONE", 3)
    one = readers.Changes(0)
    for x in range(5):
        one.note_gone(ChunkKey(x, 0, 0))
    assert [since for since in range(6) if one.known(since)] == [2, 3, 4, 5]
    assert one.gone(2) == [ChunkKey(x, 0, 0) for x in (2, 3, 4)]
    assert len(one.gone(0)) == 3

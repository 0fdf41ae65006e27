# SPDX-License-Identifier: Apache-2.0
"""Which chunks there are: page by page, what changed and what left; and lists of voxels by turns."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from shmmap.chunks.layout import HEADER_BYTES, new_header
from shmmap.chunks.voxels import ChunkKey
from shmmap.daemon.live.map_files import Row
from shmmap.daemon.live.paging.records import Scan
from shmmap.daemon.live.worker import readers
from shmmap.errors import BadRequest
from shmmap.protocol import live as messages
from shmmap.protocol.areas import BoxMessage
from shmmap.protocol.codec import decode_reply, encode
from shmmap.protocol.live import MOST_CHUNK_ROWS, LiveChunkPage, LiveChunks
from shmmap.protocol.messages import ErrorReply
from tests.support.served_map import Served


@pytest.fixture
def served(serve: Callable[..., Served]) -> Served:
    return serve()


def bring(served: Served, key: ChunkKey, generation: int = 1) -> None:
    """Put a new chunk into memory."""
    content = new_header(served.live.identity(key, generation))
    served.live.take_over(served.live.memory.create(content), 0.0)


def page(served: Served, **asked: object) -> LiveChunkPage:
    return served.map.readers.page(LiveChunks(7, "lidar", **asked))  # type: ignore[arg-type]


def keys_of(found: LiveChunkPage) -> list[ChunkKey]:
    return [ChunkKey(*row.key) for row in found.rows]


def test_more_chunks_than_go_into_one_answer(served: Served) -> None:
    there = [ChunkKey(x, -x % 7, 0) for x in range(-1300, 1300)]
    for key in there:
        served.live.files.rows[key] = Row(1, 100, 5, 3, 2, 1)
    bring(served, there[5])
    found: list[ChunkKey] = []
    after, pages = None, 0
    while True:
        one = page(served, saved=True, after=after)
        assert len(one.rows) <= MOST_CHUNK_ROWS
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
    served.map.changes.changed(b)
    chunk = served.live.chunks.pop(c)
    served.map.changes.gone(c)
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
    served.map.changes.changed(ChunkKey(0, 0, 0))
    since = served.map.changes.number
    for x in range(20_000):
        served.map.changes.gone(ChunkKey(-(1 << 24) + x, -(1 << 24), -(1 << 24)))
    row = Row(1 << 62, 1 << 40, 1 << 18, 1 << 18, 1 << 18, 1)
    for x in range(MOST_CHUNK_ROWS):
        served.live.files.rows[ChunkKey(-(1 << 24) + x, 0, -(1 << 24))] = row
    assert not page(served, since=since).since_known
    first = served.map.changes._gone[0][0]
    found = page(served, since=first, saved=True)
    assert found.since_known
    assert len(found.rows) == MOST_CHUNK_ROWS
    assert len(encode(found)) < 180_000, "a socket takes 212 992 bytes where nobody has raised that"


def test_chunks_on_their_way_in_and_out_are_listed(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    """Out: readers still map them; who asks what changed does not need to know, nor who maps chunks."""
    out, back, coming = ChunkKey(1, 0, 0), ChunkKey(2, 0, 0), ChunkKey(3, 0, 0)
    live = served.live
    readers_of = []
    for key in (out, back):
        bring(served, key)
        readers_of.append(open(f"{served.shm}{live.chunks[key].name}", "rb"))  # noqa: SIM115
        live.keep(key, live.memory.give_up(live.chunks.pop(key)))
        del live.residency.chunks[key]
    bring(served, back, 2)
    before = served.map.changes.number
    live.residency.add(Scan(1, 1, 10, {coming}))
    assert live.residency.next_load(0.0) is not None
    found = {ChunkKey(*row.key): (row.state, row.generation, row.bytes) for row in page(served).rows}
    assert found == {
        out: ("evicting", 0, HEADER_BYTES),
        back: ("clean", 2, HEADER_BYTES),
        coming: ("loading", 0, HEADER_BYTES),
    }
    assert not page(served, since=before).rows
    for reader in readers_of:
        reader.close()
    live.look_at_leases()
    assert keys_of(page(served)) == [back, coming]


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
    rows, row = served.live.files.rows, Row(1, 100, 0, 0, 0, 1)
    for x in range(3):
        rows[ChunkKey(x, 0, 0)] = row

    def touch_and_save(_area: object, key: ChunkKey, _resolution: float) -> bool:
        rows[ChunkKey(key.x, 50, 50)] = row
        return True

    monkeypatch.setattr(readers, "touches", touch_and_save)
    assert keys_of(page(served, saved=True)) == [ChunkKey(x, 0, 0) for x in range(3)]


def test_lists_of_several_readers_are_made_by_turns(served: Served) -> None:
    for x in range(40):
        bring(served, ChunkKey(x, 0, 0))
    long = served.ask(lambda n: messages.LiveVoxels(n, "lidar"))
    corner = BoxMessage(0.0, 0.0, 1.0, 1.0)
    short = served.ask(lambda n: messages.LiveVoxels(n, "lidar", area=corner), session=2)
    gone = served.ask(lambda n: messages.LiveVoxels(n, "lidar"), session=3)
    assert served.map.next_turn_s(served.now_s) == served.now_s
    served.map.left(3)
    while served.map.readers.are_waiting:
        served.map.readers.go_on()
    assert list(served.answers) == [short, long]
    assert gone not in served.answers
    assert not isinstance(served.answers[long], ErrorReply)

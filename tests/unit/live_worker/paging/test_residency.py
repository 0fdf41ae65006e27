# SPDX-License-Identifier: Apache-2.0
"""Which chunks are loaded, saved and given up, and when; the model test next door has the whole."""

from __future__ import annotations

import math

import pytest

from shmmap.chunks.voxels import ChunkKey
from shmmap.live_worker.paging.durability import TOGETHER_S, Chunk, Scan
from shmmap.live_worker.paging.residency import RETRY_S, REVIEW_S, Limits, Residency
from shmmap.live_worker.paging.windows import place_ahead
from tests.support.calls import counted_calls

HERE = ChunkKey(0, 0, 0)
PLENTY = Limits(budget_bytes=10**9, radius=0, loads=100, saves=100)


def scan_of(*keys: ChunkKey, number: int = 1, nbytes: int = 10) -> Scan:
    return Scan(1, number, nbytes, set(keys))


def load(one: Residency, now_s: float = 0.0, **content: int) -> Chunk:
    """Load what comes next."""
    chunk = one.begin_load(now_s)
    assert chunk is not None
    one.loaded(chunk, version=content.get("version", 0), nbytes=content.get("nbytes", 10), active=0)
    return chunk


def apply(one: Residency, chunk: Chunk, now_s: float = 0.0, *, grows: int = 0) -> Scan:
    """Have a chunk take in its next scan."""
    scan = chunk.waiting[0]
    one.applied(
        chunk,
        scan,
        version=chunk.version + 1,
        nbytes=chunk.nbytes + grows,
        active=chunk.active + 1,
        now_s=now_s,
    )
    return scan


def written(one: Residency, key: ChunkKey, now_s: float = 0.0) -> Chunk:
    """A chunk in memory that a scan has changed."""
    one.add(scan_of(key))
    chunk = load(one, now_s)
    apply(one, chunk, now_s)
    return chunk


def ask_for_room(one: Residency) -> None:
    """Something waits for more memory than there is: anything may be given up."""
    one.asked_bytes = one.limits.budget_bytes + 1


def flush(one: Residency) -> list[Scan]:
    """Make durable what was written."""
    one.durability.begin()
    return one.durability.flushed()


# --- windows ------------------------------------------------------------------------------------


def test_a_client_has_the_chunks_around_it_the_nearest_first() -> None:
    one = Residency(Limits(10**9, radius=1, loads=100))
    one.move("a", (0.5, 0.5, 0.5))
    order = []
    while (chunk := one.begin_load(0.0)) is not None:
        order.append(chunk.key.distance(HERE))
    assert order == [0, *[1] * 26]


@pytest.mark.parametrize(
    ("position", "center"),
    [
        ((1.19, 0.5, 0.5), (0, 0, 0)),  # not far enough over the border
        ((1.21, 0.5, 0.5), (1, 0, 0)),
        ((-0.19, 0.5, 0.5), (0, 0, 0)),
        ((-0.21, 0.5, 0.5), (-1, 0, 0)),
        ((1.3, 1.1, 0.5), (0, 0, 0)),  # over a corner: on every axis that changes
        ((1.3, 1.3, 0.5), (1, 1, 0)),
        ((1.3, 1.3, -0.3), (1, 1, -1)),
        ((2.01, 0.5, 0.5), (2, 0, 0)),  # more than a chunk away: at once
        ((-70.0, 3.0, 0.0), (-70, 3, 0)),
    ],
)
def test_a_window_follows_with_hysteresis(
    position: tuple[float, float, float], center: tuple[int, int, int]
) -> None:
    one = Residency(PLENTY)
    one.move("a", (0.5, 0.5, 0.5))
    one.move("a", position)
    assert one.windows.center("a") == center


def test_only_what_is_near_no_client_makes_room_for_what_is_near() -> None:
    one = Residency(Limits(27 * 10, radius=1, hysteresis=0.0, loads=100), new_bytes=10)
    one.move("a", (0.5, 0.5, 0.5))
    while (chunk := one.begin_load(0.0)) is not None:
        one.loaded(chunk, version=0, nbytes=10, active=0)
    one.move("a", (1.5, 0.5, 0.5))
    gone, come = set(), set()
    for _ in range(9):
        assert one.begin_load(1.0) is None
        victim = one.evict_next(1.0)
        assert victim is not None
        assert one.evict_next(1.0) is None, "no more than is needed"
        gone.add(victim.key)
        come.add(load(one, 1.0).key)
    assert ({key.x for key in gone}, {key.x for key in come}) == ({-1}, {2})
    assert one.evict_next(2.0) is None
    assert one.begin_load(2.0) is None


# --- saving -------------------------------------------------------------------------------------


def test_a_change_is_saved_in_time_the_oldest_first() -> None:
    one = Residency(PLENTY)
    one.move("a", (0.5, 0.5, 0.5))
    chunks = []
    for number in range(3):
        one.move(number, (number + 0.5, 0.5, 0.5))
        chunks.append(written(one, ChunkKey(number, 0, 0), float(number)))
    in_time = PLENTY.checkpoint_s - TOGETHER_S  # it is durable when it was flushed
    assert one.begin_save(in_time - 0.1) is None
    assert one.next_event_s(in_time - 0.1) == in_time
    assert one.begin_save(in_time) is chunks[0]
    assert one.begin_save(in_time) is None
    assert one.begin_save(in_time, everything=True) is chunks[1]


@pytest.mark.parametrize(("budget_bytes", "saved"), [(25, False), (19, True)])
def test_what_no_client_wants_is_saved_ahead_once_memory_is_half_full(budget_bytes: int, saved: bool) -> None:
    """Ten bytes: it can be given up at once then; before, more scans may come into the same save."""
    one = Residency(Limits(budget_bytes, radius=0, saves=1), new_bytes=1)
    written(one, HERE)
    assert (one.begin_save(PLENTY.linger_s) is not None) == saved


def test_durable_is_what_was_flushed() -> None:
    one = Residency(PLENTY)
    first = scan_of(HERE, ChunkKey(1, 0, 0))
    one.add(first)
    for _ in range(2):
        apply(one, load(one))
    assert first.applied
    assert not first.durable
    for _ in range(2):
        chunk = one.begin_save(0.0, everything=True)
        assert chunk is not None
        one.saved(chunk, 1, 0.0)
    assert not one.flush_is_due(0.0), "more may come"
    assert one.flush_is_due(TOGETHER_S)
    assert one.flush_is_due(0.0, everything=True)
    assert len(first.to_save) == 2
    assert flush(one) == [first]
    assert first.to_save == {}
    assert flush(one) == []


@pytest.mark.parametrize("wanted_by", ["scan", "client"])
def test_a_file_that_cannot_be_read_just_now_is_tried_again(wanted_by: str) -> None:
    one = Residency(PLENTY)
    one.add(scan_of(HERE)) if wanted_by == "scan" else one.move("a", (0.5, 0.5, 0.5))
    chunk = one.begin_load(5.0)
    assert chunk is not None
    one.load_failed(chunk, 5.0)
    assert one.begin_load(5.0 + 0.9 * RETRY_S) is None
    assert one.next_event_s(5.0) == 5.0 + RETRY_S
    again = one.begin_load(5.0 + RETRY_S)
    assert again is not None
    assert again.key == HERE


# --- giving up ----------------------------------------------------------------------------------


def test_clean_chunks_stay_until_their_room_is_needed() -> None:
    one = Residency(PLENTY)
    chunk = written(one, HERE)
    assert one.begin_save(20.0) is chunk
    one.saved(chunk, 1, 20.0)
    flush(one)
    for now_s in (20.0, 25.0, 1e6):
        assert one.evict_next(now_s) is None
        assert one.next_event_s(now_s) == math.inf, "and nothing looks for what may go"


def test_what_no_client_wants_is_given_up_first_furthest_first() -> None:
    one = Residency(Limits(10**9, radius=1, loads=100))
    one.move("a", (0.5, 0.5, 0.5))
    for x in (0, 1, 2, 9, 4):
        one.add(scan_of(ChunkKey(x, 0, 0)))
        chunk = load(one, version=3)
        one.applied(chunk, chunk.waiting[0], version=3, nbytes=10, active=1, now_s=0.0)
    ask_for_room(one)
    gone = [victim.key.x for _ in range(6) if (victim := one.evict_next(2.0)) is not None]
    assert gone == [9, 4, 2, 1, 0]


@pytest.mark.parametrize("dirty_x", [1, 6, 9])
def test_a_dirty_chunk_is_saved_to_go_when_no_clean_one_goes_before_it(dirty_x: int) -> None:
    """Else the chunks that the next scan changes are written and read again for each."""
    one = Residency(Limits(30, radius=0, loads=100, saves=100), new_bytes=10)
    one.move("a", (0.5, 9.5, 0.5))
    dirty = written(one, ChunkKey(dirty_x, 9, 0))
    for x in (4, 5):
        one.adopt(ChunkKey(x, 9, 0), version=1, saved=1, nbytes=10, active=0, now_s=0.0).changed_s = 0.0
    one.add(scan_of(ChunkKey(2, 9, 0), ChunkKey(3, 9, 0), number=7))
    gone = one.evict_next(1.0)
    assert gone is not None
    assert gone.key.x == 5, "at once, whatever else is to be saved"
    load(one, 1.0)
    assert one.begin_save(1.0) is (dirty if dirty_x > 4 else None)


def test_too_many_known_voxels_are_too_many() -> None:
    one = Residency(Limits(10**9, radius=1, most_active=2, loads=100))
    one.move("a", (0.5, 0.5, 0.5))
    for x in (0, 1):
        written(one, ChunkKey(x, 0, 0))
    assert one.begin_save(5.0) is None
    written(one, ChunkKey(-1, 0, 0))
    assert one.active == 3
    now_s = 5.0 + REVIEW_S
    chunk = one.begin_save(now_s)
    assert chunk is not None
    one.saved(chunk, 1, now_s)
    assert one.evict_next(now_s) is not None
    assert one.active == 2
    assert one.evict_next(now_s + REVIEW_S) is None


def test_room_that_was_made_for_one_is_not_another_s() -> None:
    """What is near a client is not loaded into the room that a chunk needs to take in a scan."""
    one = Residency(Limits(40, radius=1, loads=100), new_bytes=10)
    one.move("a", (0.5, 0.5, 0.5))
    one.add(scan_of(HERE))
    chunk = load(one)
    for _ in range(3):
        load(one)
    assert not one.may_grow(chunk, 15)
    for number in range(2):
        assert one.evict_next(5.0) is not None
        assert one.begin_load(5.0) is None, number
    assert one.may_grow(chunk, 15)
    apply(one, chunk, 5.0, grows=15)
    assert one.chunk_bytes == 35


def test_where_one_file_cannot_be_written_no_other_is_tried_at_once() -> None:
    one = Residency(PLENTY)
    chunks = []
    for x in range(3):
        one.move(x, (x + 0.5, 0.5, 0.5))
        chunks.append(written(one, ChunkKey(x, 0, 0)))
    assert one.begin_save(50.0) is chunks[0]
    one.save_failed(chunks[0], 50.0)
    assert one.begin_save(50.0 + RETRY_S / 2) is None
    assert one.next_event_s(50.0) == 50.0 + RETRY_S
    assert one.begin_save(50.0 + RETRY_S) is chunks[1]


@pytest.mark.parametrize("fails", [False, True])
def test_a_scan_without_memory_does_not_hold_up_others(fails: bool) -> None:
    """It gets the memory of a chunk that is saved; of one that a scan waits for only if that fails."""
    one = Residency(Limits(40, radius=0, loads=9), new_bytes=10)
    chunks = []
    for x in range(3):
        one.add(scan_of(ChunkKey(x, 0, 0), number=x + 1))
        chunks.append(load(one))
    assert one.is_ready
    for chunk in chunks[:2]:
        assert not one.may_grow(chunk, 20)
    assert [chunk for chunk, _ in one.ready()] == [chunks[2], chunks[0], chunks[1]]
    seen = [one.is_ready]
    apply(one, chunks[2])
    seen.append(one.is_ready)
    assert one.evict_next(9.0) is None
    assert one.begin_save(9.0) is chunks[2]
    assert one.evict_next(9.0) is None
    if fails:
        one.save_failed(chunks[2], 9.0)
    else:
        one.saved(chunks[2], chunks[2].version, 9.0)
    gone = one.evict_next(9.0 + REVIEW_S)
    assert gone in chunks[:2] if fails else gone is chunks[2]
    seen.append(one.is_ready)
    assert seen == [True, False, True], "there is room now"


def test_a_chunk_near_a_client_that_a_scan_needed_the_room_of_comes_back_later() -> None:
    one = Residency(Limits(10, radius=0, loads=100, saves=100), new_bytes=10)
    one.move("a", (0.5, 0.5, 0.5))
    load(one)
    one.add(scan_of(ChunkKey(9, 0, 0)))
    assert one.evict_next(0.0) is not None
    far = load(one)
    apply(one, far)
    one.saved(far, far.version, 0.0) if one.begin_save(10.0) is far else pytest.fail("it is due")
    flush(one)
    assert one.evict_next(0.1) is None, "what is near comes back later"
    assert one.next_event_s(0.1) == RETRY_S
    assert one.evict_next(10.0) is far
    assert load(one, 10.0).key == HERE


# --- giving up many ------------------------------------------------------------------------------


def test_where_memory_is_short_no_scan_waits_for_the_next_review() -> None:
    """Scans that come from elsewhere each: what they need takes the place of the last one's at once."""
    one = Residency(Limits(40, radius=0, loads=100, saves=100), new_bytes=10)
    for number in range(20):
        keys = [ChunkKey(10 * number + at, 0, 0) for at in range(4)]
        scan = scan_of(*keys, number=number + 1)
        one.add(scan)
        for _ in range(20):
            while (dirty := one.begin_save(0.0)) is not None:
                one.saved(dirty, dirty.version, 0.0)
            while one.evict_next(0.0) is not None:
                pass
            while (chunk := one.begin_load(0.0)) is not None:
                one.loaded(chunk, version=0, nbytes=10, active=0)
            for ready, _ in one.ready():
                apply(one, ready)
        assert scan.applied, "at the same moment as all others"


def test_giving_up_is_not_a_search_each_time() -> None:
    """Each chunk costs some calls, not some for every other chunk."""
    one = Residency(Limits(10**9, radius=0, loads=10**6, linger_s=0.0))
    for number in range(2000):
        one.adopt(ChunkKey(number, 0, 0), version=1, saved=1, nbytes=10, active=0, now_s=0.0)
    ask_for_room(one)
    with counted_calls() as calls:
        gone = sum(one.evict_next(float(now_s)) is not None for now_s in range(1, 100) for _ in range(50))
    assert gone == 2000
    assert calls.count <= 100 * 2000


def test_a_client_that_moves_costs_no_look_at_all_chunks() -> None:
    """Windows are counted by key, changed by the difference; nothing is looked for while there is room."""
    one = Residency(Limits(10**9, radius=1, hysteresis=0.0, loads=10**6))
    for number in range(2000):
        one.adopt(ChunkKey(number % 50, number // 50, 0), version=1, saved=1, nbytes=10, active=0, now_s=0.0)
    one.move("a", (2.5, 0.5, 0.5))
    with counted_calls() as calls:
        one.move("a", (3.5, 0.5, 0.5))
        one.begin_load(1.0)
        one.begin_save(1.0)
        one.evict_next(1.0)
    assert calls.count <= 1000


@pytest.mark.parametrize(
    ("here", "passed_s", "found"),
    [
        ((1.0, 0.5, -0.25), 0.5, (5.0, 2.5, -1.25)),
        ((0.0, 0.0, 0.0), 0.1, (0.0, 0.0, 0.0)),
        # a drive that is played back as fast as it can be: no further, and in the same direction
        ((2.0, -1.0, 0.5), 0.001, (12.0, -6.0, 3.0)),
        ((0.0, -100.0, 0.0), 0.1, (0.0, -110.0, 0.0)),
        ((1e-300, 0.0, 0.0), 1e-9, (pytest.approx(0.0), 0.0, 0.0)),
    ],
)
def test_a_client_goes_on_as_it_does(
    here: tuple[float, float, float], passed_s: float, found: tuple[float, float, float]
) -> None:
    assert place_ahead((0.0, 0.0, 0.0), here, passed_s, ahead_s=2.0, longest=10.0) == found

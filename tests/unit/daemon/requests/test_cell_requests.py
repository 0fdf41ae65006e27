# SPDX-License-Identifier: Apache-2.0
"""Requests for cells: how long they wait, where they lie, what is loaded first, how much one may ask for."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

import msgspec
import pytest

from shmmap.daemon.cache import holders
from shmmap.daemon.cache.holders import Holders
from shmmap.daemon.records import Resident
from shmmap.daemon.requests import cell_requests, limits
from shmmap.daemon.transport.sessions import Session
from shmmap.errors import BadRequest, Busy
from shmmap.layers import versions as layer_versions
from shmmap.protocol.codec import encode_handle, pack_versions
from shmmap.protocol.messages import (
    Area,
    BoxMessage,
    Cells,
    CircleMessage,
    Differential,
    HeldCell,
    Intent,
    Selected,
)
from shmmap.segment.pins import lock_slot
from tests.support.divided_map import DividedMap, make_map
from tests.unit.daemon.inner_daemon import EVERYWHERE, Inner, InnerDaemon, finish


@pytest.mark.parametrize("warm", [False, True])
def test_waits_that_are_refused(inner: Inner, small_map: DividedMap, warm: bool) -> None:
    """Whether the cells are in memory or not."""
    one = inner(small_map.root)
    session = one.session()
    if warm:
        one.everything()
    for wait in (-1.0, -0.0001, math.nan, math.inf, -math.inf, 3600.5, 1e300):
        for message in (
            Area(2, EVERYWHERE, wait=wait),
            Differential(2, EVERYWHERE, wait=wait),
            Selected(2, (), wait=wait),
        ):
            with pytest.raises(BadRequest, match="wait"):
                one.ask(session, message)
    assert not len(one.cells)
    assert not len(one.loads)


@pytest.mark.parametrize(
    ("area", "count"),
    [
        (CircleMessage(1e300, -1e300, 1e300), 16),  # squares without end: too many rather than too few
        (CircleMessage(0, 0, 1e308), 16),
        (BoxMessage(-1.7e308, -1.7e308, 1.7e308, 1.7e308), 16),
        (BoxMessage(1.6e308, 1.6e308, 1.7e308, 1.7e308), 0),
        (CircleMessage(1e308, 1e308, 0.0), 0),
    ],
)
def test_areas_at_the_end_of_the_world(
    inner: Inner, small_map: DividedMap, area: CircleMessage | BoxMessage, count: int
) -> None:
    """Some touch everything and some nothing; room can still be made and others served afterwards."""
    one = inner(small_map.root)
    reply = one.cells_for(Area(1, area, wait=30.0))
    assert len(reply.cells) == count
    assert (reply.pending, reply.failed) == ((), ())
    assert len(one.everything(2).cells) == 16
    one.offset_s += 2.0

    def empty() -> bool:
        one.evictor.free(one.ledger.budget_bytes, one.now_s())
        return one.ledger.used_bytes == one.ledger.overhead_bytes

    one.run_until(empty)


def test_nearest_cells_first(inner: Inner, small_map: DividedMap) -> None:
    """As seen from where the client says it is, else from the middle of what it asks for."""
    one = inner(small_map.root)
    session = one.session()
    with one.loaders_standing_still():
        one.ask(session, Area(1, EVERYWHERE))
        nearest = one.loads.queue.choose()
    assert nearest is not None
    assert Path(nearest.key.cell_id).name == "-20_-20.pcd"  # of the four that touch the middle
    two = inner(small_map.root)
    two.ask(two.session(), Area(1, CircleMessage(35, 35, 300)))
    nearest = two.loads.queue.choose()
    assert nearest is not None
    assert Path(nearest.key.cell_id).name == "20_20.pcd"
    two = inner(small_map.root)
    session = two.session()
    session.intent, session.says_where = Intent(-35.0, 35.0), True
    two.ask(session, Area(1, CircleMessage(35, 35, 300)))
    nearest = two.loads.queue.choose()
    assert nearest is not None
    assert Path(nearest.key.cell_id).name == "-40_20.pcd"


def test_nothing_stays_of_requests_that_are_over(inner: Inner, small_map: DividedMap) -> None:
    one = inner(small_map.root)
    session = one.session()
    with one.loaders_standing_still():
        for request in range(1, 6):
            one.ask(session, Area(request, EVERYWHERE, wait=0.01 * request))
        one.ask(session, Area(9, EVERYWHERE, wait=30.0))
        one.run_until(lambda: len(one.cells) == 1)
        one.cells.on_disconnect(session)
        assert len(one.cells) == 0
    one.run_until(lambda: one.ledger.resident_count == 16)
    one.run_until_nothing_waits()
    assert 9 not in [reply.request for _, reply in one.replies]
    assert one.statistics.values["loads_finished"] == 16, "each load has ended once"


def test_cancelled_requests(inner: Inner, small_map: DividedMap) -> None:
    """All copies of one id, of this session alone; each leaves its place to another one."""
    one = inner(small_map.root)
    session, other = one.session(), one.session()
    with one.loaders_standing_still():
        for request in (*range(1, 64), 1, 70):
            one.ask(session, Area(request, EVERYWHERE, wait=30.0))
        one.ask(other, Area(1, EVERYWHERE, wait=30.0))
        assert [reply.request for _, reply in one.replies] == [70], "the 65th does not wait"
        one.cells.cancel(session, 1)
        one.cells.cancel(session, 70)
        one.cells.cancel(session, 9999)
        assert len(one.cells) == 62 + 1
        for request in (71, 72):
            one.ask(session, Area(request, EVERYWHERE, wait=30.0))
        for request in (*range(2, 64), 71, 72):
            one.cells.cancel(session, request)
        assert len(one.cells) == 1
        assert [reply.request for _, reply in one.replies] == [70]
    assert len(one.cells_of(1).cells) == 16
    one.run_until_nothing_waits()


def test_a_cancelled_request_whose_answer_is_due(inner: Inner, small_map: DividedMap) -> None:
    one = inner(small_map.root)
    one.hold_answers = True
    session = one.session()
    one.ask(session, Selected(1, ("0_0.pcd",), wait=30.0))
    one.run_until(lambda: one.due)
    one.cells.cancel(session, 1)
    finish(one.due.pop())
    assert one.replies == []
    one.run_until_nothing_waits()


def test_waiting_requests_are_answered_in_turn(inner: Inner, small_map: DividedMap) -> None:
    """A load that many waited for answers none by itself: each answer has its own turn, if still wanted."""
    one = inner(small_map.root)
    sessions = [one.session(str(number)) for number in range(3)]
    one.hold_answers = True
    for session in sessions:
        for number in range(4):
            one.ask(session, Selected(number, ("0_0.pcd",), wait=30.0))
    one.run_until(lambda: one.due)
    assert (len(one.due), one.replies) == (12, [])
    one.cells.answer_due(one.now_s() + 60.0)
    assert len(one.due) == 12, "each is due once"
    one.cells.on_disconnect(sessions[1])
    for count, answer in enumerate(one.due):
        before = len(one.replies)
        finish(answer)
        assert len(one.replies) - before == (0 if 4 <= count < 8 else 1)
    assert len(one.cells) == 0


def test_a_request_whose_time_is_up_is_answered_in_turn(inner: Inner, small_map: DividedMap) -> None:
    one = inner(small_map.root)
    one.hold_answers = True
    one.ask(one.session(), Selected(1, ("0_0.pcd",), wait=5.0))
    one.offset_s = 6.0
    one.cells.answer_due(one.now_s())
    assert (len(one.due), one.replies, one.cells.next_s()) == (1, [], float("inf"))
    finish(one.due[0])
    ((_, reply),) = one.replies
    assert [cell.id for cell in reply.pending] == ["0_0.pcd"]
    assert 6e9 <= one.statistics._durations["wait"][0] < 60e9, "nanoseconds"


def test_cells_of_one_request(inner: Inner, small_map: DividedMap, monkeypatch: pytest.MonkeyPatch) -> None:
    one = inner(small_map.root)
    monkeypatch.setattr(limits, "MAX_CELLS", 15)
    with pytest.raises(BadRequest, match="more than 15 cells in one request"):
        one.ask(one.session(), Area(1, EVERYWHERE))
    with pytest.raises(BadRequest, match="more than 128 cells selected"):  # known or not
        one.ask(one.session(), Selected(2, ("nowhere",) * 43, ("points", "denoise", "voxel(leaf=1.0)")))
    assert not one.loads.by_key
    assert not one.ledger.by_key
    assert one.replies == []


def test_what_a_client_says_it_holds(inner: Inner, small_map: DividedMap) -> None:
    one = inner(small_map.root)
    many = limits.MAX_HELD
    for message in (
        Differential(1, EVERYWHERE, held=(HeldCell("a"),) * (many + 1)),
        Differential(1, EVERYWHERE, packed=bytes(8 * (many + 1))),
        Differential(1, EVERYWHERE, held=(HeldCell("a", 1, ("points",) * (many + 1)),)),
        Differential(
            1, EVERYWHERE, held=(HeldCell("a", 1, tuple(f"voxel(leaf={1 + n / 100})" for n in range(65))),)
        ),
    ):
        with pytest.raises(BadRequest, match="held"):
            one.ask(one.session(), message)
    one.ask(one.session(), Differential(2, EVERYWHERE, packed=bytes(8 * many)))
    assert len(one.replies) == 1


def test_loads_that_one_process_waits_for(
    inner: Inner, small_map: DividedMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Asking again for the same ones is no more of them; others' loads do not count."""
    monkeypatch.setattr(limits, "MAX_QUEUED", 5)
    one = inner(small_map.root)
    with one.loaders_standing_still():
        greedy, other = one.session(), one.session()
        assert len(one.cells_for(Area(1, EVERYWHERE), greedy).pending) == 16
        assert len(one.cells_for(Area(2, EVERYWHERE), greedy).pending) == 16
        with pytest.raises(Busy, match="5 loads"):
            one.ask(greedy, Area(3, EVERYWHERE, ("voxel(leaf=1.0)",)))
        assert len(one.cells_for(Area(4, EVERYWHERE, ("voxel(leaf=1.0)",)), other).pending) == 16
    one.run_until(lambda: not len(one.loads))
    assert len(one.cells_for(Area(5, EVERYWHERE, ("voxel(leaf=2.0)",), 30.0), greedy).cells) == 16


def test_layers(inner: Inner, small_map: DividedMap) -> None:
    one = inner(small_map.root)
    with pytest.raises(BadRequest, match="17 layers in one request"):
        one.ask(one.session(), Area(1, EVERYWHERE, ("points",) * 17))


def test_a_layer_that_would_look_into_too_many_cells(
    inner: Inner, small_map: DividedMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(layer_versions, "MAX_NEIGHBOURS", 5)
    one = inner(small_map.root)
    for message in (
        Area(1, EVERYWHERE, ("points", "normals(radius=10)")),
        Differential(2, EVERYWHERE, ("normals(radius=10)",)),
        Selected(3, ("0_0.pcd",), ("denoise(halo=10)",)),
    ):
        with pytest.raises(BadRequest, match="would look into about 9 cells around each one"):
            one.ask(one.session(), message)
    assert not one.loads.by_key


def test_intents() -> None:
    limits.check_intent(Intent(1.0, 2.0, route=((3.0, 4.0),)))
    for wrong in (
        Intent(math.nan, 0.0),
        Intent(0.0, 0.0, heading=math.inf),
        Intent(0.0, 0.0, route=((0.0, math.nan),)),
    ):
        with pytest.raises(BadRequest, match="finite"):
            limits.check_intent(wrong)


@pytest.fixture
def many(inner: Inner, tmp_path: Path) -> InnerDaemon:
    """Return a daemon of 60 cells."""
    return inner(make_map(tmp_path / "map", columns=10, rows=6, points=10).root)


def ids(many: InnerDaemon, first: int, last: int) -> tuple[str, ...]:
    return tuple(many.cache.catalogue.id(index) for index in range(first, last))


def full(many: InnerDaemon, *, map_them: bool = False) -> tuple[Session, list[int]]:
    """Return a session that was handed 50 cells, which is all that it may keep; descriptors of them."""
    session = many.session()
    cells = many.cells_for(Selected(1, ids(many, 0, 50), wait=30.0), session).cells
    opened = [os.open(many.path_of(cell.segment), os.O_RDONLY) for cell in cells] if map_them else []
    for fd in opened:
        lock_slot(fd, session.slot)
    many.cells._quota.nbytes = session.held_bytes
    many.offset_s += 2.0
    return session, opened


def test_a_few_looks_a_request(many: InnerDaemon, monkeypatch: pytest.MonkeyPatch) -> None:
    """It holds 50 and maps none: enough of them are dropped for what it asks for now, the oldest first."""
    looks, look = 0, Holders.has

    def counted(found: Holders, resident: Resident, slot: int) -> bool:
        nonlocal looks
        looks += 1
        return look(found, resident, slot)

    monkeypatch.setattr(Holders, "has", counted)
    session, _ = full(many)
    assert (
        len(many.cells_for(Selected(2, ids(many, 50, 60) + ids(many, 0, 8), wait=30.0), session).cells) == 18
    )
    assert many.statistics.values["refused_quota"] == 0
    assert 10 <= looks < 50
    assert {r.key.cell_id for held in session.held.values() for r in held} >= set(ids(many, 30, 60))


def test_the_next_request_looks_at_others(many: InnerDaemon, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the 50 that it holds it still maps the first ones: looking at those alone finds no room."""
    monkeypatch.setattr(holders, "MAX_LOOKS", 10)
    session, opened = full(many, map_them=True)
    for fd in opened[20:]:
        os.close(fd)
    found = []
    for request in range(2, 6):
        many.offset_s += 2.0
        found.append(len(many.cells_for(Selected(request, ids(many, 50, 60), wait=30.0), session).cells))
    assert found[:2] == [0, 0]
    assert found[3] == 10
    for fd in opened[:20]:
        os.close(fd)


def test_what_it_still_maps_counts(many: InnerDaemon) -> None:
    """It is refused what is too much."""
    session, opened = full(many, map_them=True)
    reply = many.cells_for(Selected(2, ids(many, 45, 60), wait=30.0), session)
    assert len(reply.cells) + len(reply.failed) == 15
    assert {failure.code for failure in reply.failed} == {"over_budget"}
    assert many.statistics.values["refused_quota"] == len(reply.failed) > 0
    for fd in opened:
        os.close(fd)
    assert len(many.cells_for(Selected(4, ids(many, 50, 60), wait=30.0), session).cells) == 10


HALF = BoxMessage(-1e3, -1e3, -1.0, 1e3)


class LongWay(Exception):
    """The request was answered with what covers everything."""


def long_way(*_: object, **_options: object) -> NoReturn:
    raise LongWay


@pytest.fixture
def warm(tmp_path: Path) -> Iterator[tuple[InnerDaemon, Cells]]:
    """A daemon that has all of its map in memory, and the reply that says so."""
    made = make_map(tmp_path / "map", columns=3, rows=2, points=20)
    inner = InnerDaemon(str(made.root), cache_dir=str(tmp_path / "cache"))
    yield inner, inner.everything()
    inner.close()


def differential(
    inner: InnerDaemon, request: int, area: BoxMessage, versions: list[int], **more: object
) -> Cells:
    message = Differential(request, area, packed=pack_versions(versions), **more)  # type: ignore[arg-type]
    inner.ask(inner.session(), message)
    return inner.cells_of(request)


def test_handles_are_encoded_once(warm: tuple[InnerDaemon, Cells]) -> None:
    """Replies carry the bytes that each segment was given when it came into memory."""
    inner, everything = warm
    session = inner.session()
    inner.ask(session, Differential(2, EVERYWHERE))
    (_, first), *_ = [reply for reply in inner.replies if reply[1].request == 2]
    residents = [resident for held in session.held.values() for resident in held]
    assert len(residents) == len(first.cells) == len(everything.cells)
    for resident in residents:  # marked, so that it shows whose bytes they are
        handle = next(cell for cell in first.cells if cell.version == resident.version)
        resident.handle = encode_handle(msgspec.structs.replace(handle, points=4711))
    for request, reply in ((3, differential(inner, 3, EVERYWHERE, [])), (4, inner.everything(4))):
        assert {cell.points for cell in reply.cells} == {4711}, request


def test_what_others_hold_does_not_count(
    warm: tuple[InnerDaemon, Cells], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is in memory may come to more than one session may have: it is answered from versions, too."""
    inner, everything = warm
    monkeypatch.setattr(cell_requests, "difference", long_way)
    sizes = [cell.bytes for cell in everything.cells]
    inner.cells._quota.nbytes = sum(sizes[:2])
    assert inner.ledger.resident_bytes > inner.cells._quota.nbytes
    held = [cell.version for cell in everything.cells]
    assert len(differential(inner, 2, EVERYWHERE, held[2:]).cells) == 2
    with pytest.raises(LongWay):
        differential(inner, 3, EVERYWHERE, held[3:])


def test_what_another_request_got_is_not_forgotten(warm: tuple[InnerDaemon, Cells]) -> None:
    """Two windows of one client: each says what it holds; the session has both until it releases them."""
    inner, everything = warm
    session = inner.session()
    half = Differential(2, HALF)
    inner.ask(session, half)
    inner.ask(session, Differential(3, EVERYWHERE))
    inner.ask(session, half)
    held = {cell.version for cell in everything.cells}
    assert session.held.keys() == held
    assert session.held_bytes == sum(cell.bytes for cell in everything.cells)

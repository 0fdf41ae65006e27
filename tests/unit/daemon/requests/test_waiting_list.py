# SPDX-License-Identifier: Apache-2.0
"""Waiting requests: the next deadline is always right, and one session cannot fill the list."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from shmmap.daemon.cache.ledger import Ledger
from shmmap.daemon.records import Key
from shmmap.daemon.requests.waiting_list import (
    MAX_OF_A_SESSION,
    MAX_WEIGHT,
    MAX_WEIGHT_OF_A_PROCESS,
    TAKEN_PER_TURN,
    CellRequest,
    WaitingList,
)
from shmmap.daemon.transport.sessions import Session, Sessions
from shmmap.protocol.messages import Differential, HeldCell, Selected, SquareMessage
from tests.support import connections

A, B = Key("a", "points"), Key("b", "points")


def waiting_request(session: Session, deadline_s: float, cells: int = 0) -> CellRequest:
    request = CellRequest(session, Selected(1, ()), ("points",), None, 0.0, deadline_s)
    request.weigh(cells)
    return request


def sessions(count: int) -> list[Session]:
    opened = Sessions()
    return [opened.open(connections.of(), "", 0.0) for n in range(count)]


def add(waiting: WaitingList, request: CellRequest, *keys: Key, pages: tuple[int, ...] = ()) -> None:
    waiting.wait(request, set(keys), keys, pages)


def test_one_session_has_its_share() -> None:
    mine, other = sessions(2)
    waiting = WaitingList(Ledger(0))
    requests = [waiting_request(mine, float(n)) for n in range(MAX_OF_A_SESSION)]
    for request in requests:
        assert waiting.has_room(request)
        add(waiting, request)
    one_more = waiting_request(mine, 0.0)
    assert not waiting.has_room(one_more)
    assert waiting.has_room(requests[0]), "it has its place"
    assert waiting.has_room(waiting_request(other, 0.0))
    waiting.remove(requests[0])
    assert waiting.has_room(one_more)


def test_what_waits_is_limited() -> None:
    """However large the requests are, a process has its share of them, and there is a limit for all."""
    waiting = WaitingList(Ledger(0))
    whole, added = MAX_WEIGHT_OF_A_PROCESS // 2, []
    for owner in sessions(MAX_WEIGHT // MAX_WEIGHT_OF_A_PROCESS):
        for _ in range(2):
            request = waiting_request(owner, 1.0, whole)
            assert waiting.has_room(request)
            add(waiting, request)
            added.append(request)
        assert not waiting.has_room(waiting_request(owner, 1.0, 1))
    (other,) = sessions(1)
    assert not waiting.has_room(waiting_request(other, 1.0, 1))
    waiting.remove(added[0])
    assert waiting.has_room(waiting_request(other, 1.0, whole))
    assert not waiting.has_room(waiting_request(other, 1.0, whole + 1))


def test_what_a_request_names_as_held_weighs() -> None:
    (owner,) = sessions(1)
    for held, packed, weight in ((0, 0, 3), (100, 0, 50), (0, 256 * 40, 40), (100, 256 * 40, 90)):
        message = Differential(1, SquareMessage(0, 0, 1), held=(HeldCell("a"),) * held, packed=bytes(packed))
        request = CellRequest(owner, message, ("points",), None, 0.0, 1.0)
        request.weigh(3)
        assert request.weight == weight


def test_many_that_are_overdue_are_taken_some_at_a_time() -> None:
    waiting = WaitingList(Ledger(0))
    for owner in sessions(2 * TAKEN_PER_TURN // MAX_OF_A_SESSION):
        for number in range(MAX_OF_A_SESSION):
            add(waiting, waiting_request(owner, float(number)))
    taken: list[CellRequest] = []
    while part := waiting.take(1e9):
        assert len(part) == TAKEN_PER_TURN
        taken += part
    assert len(set(map(id, taken))) == len(waiting) == 2 * TAKEN_PER_TURN


def test_it_is_due_when_nothing_is_left_to_wait_for() -> None:
    ledger = Ledger(0)
    waiting = WaitingList(ledger)
    (owner,) = sessions(1)
    both, paged = waiting_request(owner, 9.0), waiting_request(owner, 9.0)
    add(waiting, both, A, B)
    add(waiting, paged, B, pages=(3, 4))
    assert set(ledger.needed()) == {A, B}
    waiting.load_finished(A)
    assert waiting.take(0.0) == []
    waiting.load_finished(B)
    assert (waiting.next_s(), waiting.take(0.0)) == (0.0, [both])
    waiting.page_finished(4)
    waiting.page_finished(3)
    assert waiting.take(0.0) == [paged], "once"
    assert waiting.take(99.0) == [], "both are taken already"
    assert paged.attempts == -1, "an attempt after which a page came does not count"
    add(waiting, both, A)
    assert set(ledger.needed()) == {A, B}
    waiting.remove(paged)
    waiting.release(paged)
    assert (set(ledger.needed()), waiting.next_s()) == ({A}, 9.0)
    assert waiting.take(9.0) == [both]
    waiting.remove(both)
    waiting.release(both)
    assert (list(ledger.needed()), waiting._of_load, waiting._of_page, waiting.take(99.0)) == ([], {}, {}, [])


def test_another_map_has_other_pages() -> None:
    waiting = WaitingList(Ledger(0))
    (owner,) = sessions(1)
    of_page, of_load = waiting_request(owner, 9.0), waiting_request(owner, 9.0)
    add(waiting, of_page, A, pages=(3,))
    add(waiting, of_load, A)
    waiting.map_changed()
    assert waiting.take(0.0) == [of_page]


@given(st.lists(st.tuples(st.integers(0, 2), st.integers(0, 50), st.booleans(), st.booleans())))
def test_against_a_plain_list(steps: list[tuple[int, int, bool, bool]]) -> None:
    owners = sessions(3)
    waiting = WaitingList(Ledger(0))
    model, taken = list[CellRequest](), set[CellRequest]()
    for owner, deadline, leave, again in steps:
        request = waiting_request(owners[owner], float(deadline))
        add(waiting, request)
        model.append(request)
        if leave:
            gone = model.pop(deadline % len(model))
            waiting.remove(gone)
        assert sorted(map(id, waiting)) == sorted(map(id, model))
        assert len(waiting) == len(model)
        undue = [r for r in model if r not in taken]
        assert waiting.next_s() == min((r.deadline_s for r in undue), default=float("inf"))
        overdue = waiting.take(25.0)
        assert sorted(map(id, overdue)) == sorted(id(r) for r in undue if r.deadline_s <= 25.0)
        assert waiting.take(25.0) == [], "once"
        taken.update(overdue)
        if again and overdue:
            add(waiting, overdue[0])
            taken.discard(overdue[0])
            assert waiting.take(25.0) == [overdue[0]]
            taken.add(overdue[0])
        assert waiting.of(owners[owner]) == [r for r in model if r.session is owners[owner]]

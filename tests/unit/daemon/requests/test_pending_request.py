# SPDX-License-Identifier: Apache-2.0
"""Waiting requests: the next deadline is always right, and one session cannot fill the list."""

from __future__ import annotations

from typing import cast

from hypothesis import given
from hypothesis import strategies as st

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.cache.ledger import Ledger
from shmmap.daemon.requests.pending_request import (
    MAX_CELLS,
    MAX_CELLS_OF_A_PROCESS,
    MAX_OF_A_SESSION,
    OVERDUE_PER_TURN,
    Found,
    PendingRequest,
    WaitingList,
)
from shmmap.daemon.transport.sessions import Session, Sessions
from tests.support import connections


def waiting_request(session: Session, deadline_s: float, cells: int = 0) -> PendingRequest:
    found = Found(cells=[(0, "points")] * cells)
    return PendingRequest(
        cast("CellCache", None), session, 0, (), lambda _wanted: iter(()), found=found, deadline_s=deadline_s
    )


def waiting_list() -> WaitingList:
    return WaitingList(Ledger(0))


def sessions(count: int) -> list[Session]:
    opened = Sessions()
    return [opened.open(connections.of(), "", 0.0) for n in range(count)]


def test_one_session_has_its_share() -> None:
    mine, other = sessions(2)
    waiting = waiting_list()
    requests = [waiting_request(mine, float(n)) for n in range(MAX_OF_A_SESSION)]
    for request in requests:
        assert waiting.has_room(request)
        waiting.add(request)
    one_more = waiting_request(mine, 0.0)
    assert not waiting.has_room(one_more)
    assert waiting.has_room(waiting_request(other, 0.0))
    waiting.remove(requests[0])
    assert waiting.has_room(one_more)


def test_cells_that_wait_are_limited() -> None:
    """However large the requests are, a process has its share of them, and there is a limit for all."""
    waiting = waiting_list()
    whole, added = MAX_CELLS_OF_A_PROCESS // 2, []
    for owner in sessions(MAX_CELLS // MAX_CELLS_OF_A_PROCESS):
        for _ in range(2):
            request = waiting_request(owner, 1.0, whole)
            assert waiting.has_room(request)
            waiting.add(request)
            added.append(request)
        assert not waiting.has_room(waiting_request(owner, 1.0, 1))
    (other,) = sessions(1)
    assert not waiting.has_room(waiting_request(other, 1.0, 1))
    added[0].found = Found()  # what it asks for has left the map meanwhile
    waiting.remove(added[0])
    assert waiting.has_room(waiting_request(other, 1.0, whole))
    assert not waiting.has_room(waiting_request(other, 1.0, whole + 1))


def test_many_that_are_overdue_are_taken_some_at_a_time() -> None:
    waiting = waiting_list()
    for owner in sessions(2 * OVERDUE_PER_TURN // MAX_OF_A_SESSION):
        for number in range(MAX_OF_A_SESSION):
            waiting.add(waiting_request(owner, float(number)))
    taken: list[PendingRequest] = []
    while part := waiting.overdue(1e9):
        assert len(part) == OVERDUE_PER_TURN
        taken += part
    assert len(set(map(id, taken))) == len(waiting) == 2 * OVERDUE_PER_TURN


@given(st.lists(st.tuples(st.integers(0, 2), st.integers(0, 50), st.booleans())))
def test_against_a_plain_list(steps: list[tuple[int, int, bool]]) -> None:
    owners = sessions(3)
    waiting = waiting_list()
    model, taken = list[PendingRequest](), set[PendingRequest]()
    for owner, deadline, leave in steps:
        request = waiting_request(owners[owner], float(deadline))
        waiting.add(request)
        model.append(request)
        if leave:
            gone = model.pop(deadline % len(model))
            waiting.remove(gone)
        assert sorted(map(id, waiting)) == sorted(map(id, model))
        assert len(waiting) == len(model)
        undue = [r for r in model if r not in taken]
        assert waiting.next_deadline_s() == min((r.deadline_s for r in undue), default=float("inf"))
        overdue = waiting.overdue(25.0)
        assert sorted(map(id, overdue)) == sorted(id(r) for r in undue if r.deadline_s <= 25.0)
        for one in overdue:
            assert waiting.take(one)
            assert not waiting.take(one), "once"
            taken.add(one)
        assert waiting.of(owners[owner]) == [r for r in model if r.session is owners[owner]]

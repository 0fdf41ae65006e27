# SPDX-License-Identifier: Apache-2.0
"""Waiting requests: the next deadline is always right, and one session cannot fill the list."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from shmmap.daemon.cache.ledger import Ledger
from shmmap.daemon.requests.pending_request import (
    MOST_CELLS,
    MOST_CELLS_OF_A_PROCESS,
    MOST_OF_A_SESSION,
    OVERDUE_AT_ONCE,
    PendingRequest,
    WaitingList,
)
from shmmap.daemon.transport.sessions import Session, Sessions
from tests.support import connections


def waiting_request(session: Session, deadline_s: float, cells: int = 0) -> PendingRequest:
    return PendingRequest(
        session, 0, (), lambda _wanted: iter(()), cells=[(0, "points")] * cells, deadline_s=deadline_s
    )  # fmt: skip


def waiting_list() -> WaitingList:
    return WaitingList(Ledger(0), lambda _request: None, lambda _residents: None)


def sessions(count: int) -> list[Session]:
    opened = Sessions()
    return [opened.open(connections.of(), "", 0.0) for n in range(count)]


def test_one_session_has_its_share() -> None:
    mine, other = sessions(2)
    waiting = waiting_list()
    requests = [waiting_request(mine, float(n)) for n in range(MOST_OF_A_SESSION)]
    for request in requests:
        assert waiting.has_room(request)
        waiting.add(request)
    one_more = waiting_request(mine, 0.0)
    assert not waiting.has_room(one_more)
    assert waiting.has_room(waiting_request(other, 0.0))
    waiting.remove(requests[0])
    assert waiting.has_room(one_more)


def test_cells_that_wait_are_limited() -> None:
    """However large the requests are, a process has its share of them, and all together a most."""
    waiting = waiting_list()
    whole, added = MOST_CELLS_OF_A_PROCESS // 2, []
    for owner in sessions(MOST_CELLS // MOST_CELLS_OF_A_PROCESS):
        for _ in range(2):
            request = waiting_request(owner, 1.0, whole)
            assert waiting.has_room(request)
            waiting.add(request)
            added.append(request)
        assert not waiting.has_room(waiting_request(owner, 1.0, 1))
    (stranger,) = sessions(1)
    assert not waiting.has_room(waiting_request(stranger, 1.0, 1))
    added[0].cells = []  # what it asks for has left the map meanwhile
    waiting.remove(added[0])
    assert waiting.has_room(waiting_request(stranger, 1.0, whole))
    assert not waiting.has_room(waiting_request(stranger, 1.0, whole + 1))


def test_many_that_are_overdue_are_taken_little_by_little() -> None:
    waiting = waiting_list()
    for owner in sessions(2 * OVERDUE_AT_ONCE // MOST_OF_A_SESSION):
        for number in range(MOST_OF_A_SESSION):
            waiting.add(waiting_request(owner, float(number)))
    taken: list[PendingRequest] = []
    while part := waiting.overdue(1e9):
        assert len(part) == OVERDUE_AT_ONCE
        taken += part
    assert len(set(map(id, taken))) == len(waiting) == 2 * OVERDUE_AT_ONCE


@given(st.lists(st.tuples(st.integers(0, 2), st.integers(0, 50), st.booleans())))
def test_against_a_plain_list(steps: list[tuple[int, int, bool]]) -> None:
    owners = sessions(3)
    waiting = waiting_list()
    model: list[PendingRequest] = []
    for owner, deadline, leave in steps:
        request = waiting_request(owners[owner], float(deadline))
        waiting.add(request)
        model.append(request)
        if leave:
            gone = model.pop(deadline % len(model))
            waiting.remove(gone)
        assert sorted(map(id, waiting)) == sorted(map(id, model))
        assert len(waiting) == len(model)
        undue = [r for r in model if not r.due]
        assert waiting.next_deadline_s() == min((r.deadline_s for r in undue), default=float("inf"))
        overdue = waiting.overdue(25.0)
        assert sorted(map(id, overdue)) == sorted(id(r) for r in undue if r.deadline_s <= 25.0)
        for one in overdue:
            one.due = True
        assert waiting.of(owners[owner]) == [r for r in model if r.session is owners[owner]]

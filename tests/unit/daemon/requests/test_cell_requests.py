# SPDX-License-Identifier: Apache-2.0
"""Requests for cells: how long they wait, where they lie, what is loaded first, what stays of them."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from shmmap.errors import BadRequest
from shmmap.protocol.messages import (
    Area,
    BoxMessage,
    CircleMessage,
    Differential,
    Intent,
    Selected,
)
from tests.support.divided_map import DividedMap
from tests.unit.daemon.inner_daemon import EVERYWHERE, Inner, finish


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


def test_waits_that_are_answered_at_once(inner: Inner, small_map: DividedMap) -> None:
    one = inner(small_map.root)
    session = one.session()
    for request, wait in ((1, None), (2, 0.0), (3, -0.0)):
        one.ask(session, Area(request, EVERYWHERE, wait=wait))
        (reply,) = [reply for _, reply in one.replies if reply.request == request]
        assert len(reply.pending) == 16
    one.ask(session, Area(4, EVERYWHERE, wait=3600.0))
    assert len(one.cells_of(4).cells) == 16


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
    session = one.session()
    one.ask(session, Area(1, area, wait=30.0))
    reply = one.cells_of(1)
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
        nearest = one.loads.next_queued()
    assert nearest is not None
    assert Path(nearest.key.cell_id).name == "-20_-20.pcd"  # of the four that touch the middle
    two = inner(small_map.root)
    two.ask(two.session(), Area(1, CircleMessage(35, 35, 300)))
    nearest = two.loads.next_queued()
    assert nearest is not None
    assert Path(nearest.key.cell_id).name == "20_20.pcd"
    two = inner(small_map.root)
    session = two.session()
    session.intent, session.says_where = Intent(-35.0, 35.0), True
    two.ask(session, Area(1, CircleMessage(35, 35, 300)))
    nearest = two.loads.next_queued()
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
    assert not one.ledger._needed
    assert one.cells.next_deadline_s() == math.inf
    assert 9 not in [reply.request for _, reply in one.replies]
    assert sorted(one.ended) == sorted(one.ledger.by_key), "each load has ended once"


def test_waiting_requests_are_answered_in_turn(inner: Inner, small_map: DividedMap) -> None:
    """A load that many waited for answers none by itself: each answer has its own turn, if still wanted."""
    one = inner(small_map.root)
    sessions = [one.session(str(number)) for number in range(3)]
    one.hold_answers = True
    for session in sessions:
        for number in range(4):
            one.ask(session, Selected(number, ("0_0.pcd",), wait=30.0))
    one.run_until(lambda: one.ended)
    assert (len(one.due), one.replies) == (12, [])
    one.cells.answer_overdue(one.now_s() + 60.0)
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
    one.cells.answer_overdue(one.now_s())
    assert (len(one.due), one.replies, one.cells.next_deadline_s()) == (1, [], float("inf"))
    finish(one.due[0])
    ((_, reply),) = one.replies
    assert [cell.id for cell in reply.pending] == ["0_0.pcd"]

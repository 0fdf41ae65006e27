# SPDX-License-Identifier: Apache-2.0
"""What an operator asks about very many cells is done in parts, and others have their turns in between."""

from __future__ import annotations

import math
from typing import Any, cast

import pytest

from shmmap.daemon.map.catalogue_reload import Reloader
from shmmap.daemon.requests.operators.operator_pins import MAX_PINS, OperatorPins
from shmmap.daemon.requests.operators.operator_requests import OperatorRequests
from shmmap.errors import BadRequest
from shmmap.protocol.messages import Evict, Evicted, Pin, Unpin
from tests.support.divided_map import DividedMap, make_map
from tests.unit.daemon.inner_daemon import Inner, InnerDaemon, finish

SIDE = 9
CELLS = SIDE * SIDE
pytestmark = pytest.mark.usefixtures("short_turns")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> DividedMap:
    return make_map(tmp_path_factory.mktemp("large") / "map", columns=SIDE, rows=SIDE, points=5)


def operators_of(one: InnerDaemon) -> OperatorRequests:
    return OperatorRequests(one.cache, OperatorPins(one.cache, one.scheduler), cast("Reloader", None))


def reply_to(one: InnerDaemon, request: int) -> Any:
    (found,) = [reply for _, reply in one.replies if reply.request == request]
    return found


def test_everything_is_evicted_in_parts(inner: Inner, made: DividedMap) -> None:
    one = inner(str(made.root))
    one.everything()
    operators, left = operators_of(one), [one.ledger.resident_count]
    left += [one.ledger.resident_count for _ in operators.handle(one.session(), Evict(5), one.now_s())]
    assert (left[0], one.ledger.resident_count) == (CELLS, 0)
    assert left[1:] == list(range(CELLS, 0, -1))
    assert reply_to(one, 5) == Evicted(5, CELLS, 0)


def test_what_is_gone_meanwhile_is_not_evicted_again(inner: Inner, made: DividedMap) -> None:
    one = inner(str(made.root))
    one.everything()
    operators = operators_of(one)
    first = operators.handle(one.session(), Evict(5), one.now_s())
    next(first)
    finish(operators.handle(one.session(), Evict(6), one.now_s()))
    finish(first)
    assert reply_to(one, 5).freed + reply_to(one, 6).freed == CELLS


def test_named_cells_are_evicted_and_pinned_in_parts(inner: Inner, made: DividedMap) -> None:
    one = inner(str(made.root))
    one.everything()
    operators, ids = operators_of(one), tuple(made.corners)
    steps = len(list(operators.handle(one.session(), Pin(5, (*ids, "nowhere")), one.now_s())))
    assert steps >= 3 * CELLS
    pinned = reply_to(one, 5)
    assert (len(pinned.cells), pinned.unknown) == (CELLS, ("nowhere",))
    finish(operators.handle(one.session(), Evict(6, ids), one.now_s()))
    assert reply_to(one, 6) == Evicted(6, 0, 0, (), CELLS)
    finish(operators.handle(one.session(), Unpin(7, ids[:-1]), one.now_s()))
    assert [cell.id for cell in reply_to(one, 7).cells] == [ids[-1]]
    finish(operators.handle(one.session(), Evict(8, ids), one.now_s()))
    assert reply_to(one, 8) == Evicted(8, CELLS - 1, 0, (), 1)
    finish(operators.handle(one.session(), Unpin(9), one.now_s()))
    one.run_until(lambda: one.cells.next_deadline_s() == math.inf)
    assert (reply_to(one, 9).cells, operators.pins._total, one.ledger._needed) == ((), 0, {})


def test_too_many_pins(inner: Inner, made: DividedMap, monkeypatch: pytest.MonkeyPatch) -> None:
    one = inner(str(made.root))
    operators, ids = operators_of(one), tuple(made.corners)
    with pytest.raises(BadRequest, match="cells in one request"):
        finish(operators.handle(one.session(), Pin(5, ids * (MAX_PINS // CELLS + 1)), one.now_s()))
    monkeypatch.setattr(f"{OperatorPins.__module__}.MAX_PINS", 40)
    finish(operators.handle(one.session(), Pin(6, ids[:40]), one.now_s()))
    with pytest.raises(BadRequest, match="more than 40 cells would be pinned"):
        finish(operators.handle(one.session(), Pin(7, ids[40:41]), one.now_s()))
    finish(operators.handle(one.session(), Pin(8, ids[:1]), one.now_s()))  # it is already

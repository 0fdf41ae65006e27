# SPDX-License-Identifier: Apache-2.0
"""A request for very many cells takes several turns, and others have theirs in between."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from shmmap.daemon import turns
from shmmap.daemon.requests import limits
from shmmap.daemon.requests.dispatch import Dispatch
from shmmap.errors import BadRequest, NoSession, ShmmapError
from shmmap.protocol.codec import pack_versions
from shmmap.protocol.messages import Area, CircleMessage, Differential, HeldCell, Release, Selected
from tests.support.divided_map import DividedMap, make_map
from tests.unit.daemon.inner_daemon import EVERYWHERE, Inner, InnerDaemon, finish, names

SIDE = 14
CELLS = SIDE * SIDE
LONG_S = 3000.0
"""Longer than a test waits for anything: no reply leaves early because the loads are slow."""
short_turns = pytest.mark.usefixtures("short_turns")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> DividedMap:
    return make_map(tmp_path_factory.mktemp("large") / "map", columns=SIDE, rows=SIDE, points=5)


def test_a_turn_ends_when_its_time_is_used(
    inner: Inner, made: DividedMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However many cells it is for.  Here time goes on with each look at it, a quarter of a turn's."""
    looks = itertools.count()
    monkeypatch.setattr(turns, "time", SimpleNamespace(monotonic=lambda: next(looks) * turns.TURN_S / 4))
    one = inner(str(made.root))
    session = one.session()

    def longest(work: Iterator[None]) -> int:
        """Looks at the time in the longest turn; each batch of cells costs one."""
        times = [next(looks)]
        times += [next(looks) for _ in work]
        return max(b - a for a, b in itertools.pairwise((*times, next(looks))))

    for count in (1, 2):  # cold, warm
        assert longest(one.cells.area(session, Area(count, EVERYWHERE, wait=LONG_S))) <= 8
        assert len(one.cells_of(count).cells) == CELLS
    ids = tuple(cell.id for cell in one.cells_of(2).cells)
    assert longest(one.cells.selected(session, Selected(3, ids))) <= 8
    held = tuple(HeldCell(cell) for cell in ids)
    assert longest(one.cells.differential(session, Differential(4, EVERYWHERE, held=held))) <= 8
    assert [len(one.cells_of(count).cells) for count in (3, 4)] == [CELLS, 0]


@short_turns
def test_others_are_answered_between_its_turns(inner: Inner, made: DividedMap) -> None:
    one = inner(str(made.root))
    one.everything()
    work = one.cells.area(one.session("large"), Area(2, EVERYWHERE))
    next(work)
    one.ask(one.session("small"), Area(3, CircleMessage(0, 0, 5)))
    assert [reply.request for _, reply in one.replies] == [1, 3]
    finish(work)
    assert [reply.request for _, reply in one.replies] == [1, 3, 2]
    assert len(one.cells_of(2).cells) == CELLS


@short_turns
def test_what_a_client_is_given_is_noted_with_the_reply(inner: Inner, made: DividedMap) -> None:
    """Else a client that leaves at once, and keeps what it maps, would be known to no one."""
    one = inner(str(made.root))
    one.everything(999)
    session = one.session()
    work = one.cells.area(session, Area(1, EVERYWHERE))
    while not any(reply.request == 1 for _, reply in one.replies):
        next(work)
    assert len(session.held) == CELLS


@short_turns
def test_nothing_stays_of_one_whose_client_leaves_meanwhile(inner: Inner, made: DividedMap) -> None:
    """Wherever it is then: nothing is kept for it."""
    one = inner(str(made.root))
    one.pool.limit = 0
    for count in range(1, 4 * CELLS, CELLS // 4):
        session = one.session()
        work = one.cells.area(session, Area(count, EVERYWHERE, wait=LONG_S))
        for _ in range(count):
            next(work)
        one.cells.on_disconnect(session)
        one.sessions.close(session)
        del work  # as the loop does once the connection has ended
        one.run_until_nothing_waits()
    assert one.replies == []


@short_turns
def test_the_request_of_a_session_that_ends_meanwhile_is_refused(inner: Inner, made: DividedMap) -> None:
    one = inner(str(made.root))
    session = one.session()
    work = one.cells.area(session, Area(1, EVERYWHERE, wait=LONG_S))
    next(work)
    one.sessions.close(session)
    with pytest.raises(NoSession):
        finish(work)
    one.run_until_nothing_waits()


@short_turns
@pytest.mark.parametrize("warm", [False, True])
def test_the_map_changes_meanwhile(inner: Inner, tmp_path: Path, warm: bool) -> None:
    """At any of its steps: it is answered for the map as it is then, once."""
    made = make_map(tmp_path / "map", columns=SIDE, rows=SIDE, points=5)
    one = inner(str(made.root))
    if warm:
        one.everything(999)
    gone = sorted(made.corners)
    for count in range(1, 4 * CELLS, CELLS // 4):
        work = one.cells.area(one.session(), Area(count, EVERYWHERE, wait=LONG_S))
        for _ in range(count):
            next(work, None)
        cells, answered = sorted(made.corners), any(reply.request == count for _, reply in one.replies)
        del made.corners[gone.pop(0)]  # every index after it is another one's now
        made.write_metadata()
        one.reload()
        finish(work)
        assert names(one.cells_of(count)) == (cells if answered else cells[1:])
        assert len([reply for _, reply in one.replies if reply.request == count]) == 1
    one.run_until_nothing_waits()


@short_turns
def test_many_loads_end_while_it_is_gone_through(inner: Inner, made: DividedMap) -> None:
    """All of what it would wait for is there before it waits: it is answered all the same."""
    one = inner(str(made.root))
    session = one.session()
    work = one.cells.area(session, Area(1, EVERYWHERE, wait=LONG_S))
    while len(one.loads) < CELLS:
        next(work)
    one.run_until(lambda: one.ledger.resident_count == CELLS)
    finish(work)
    assert len(one.cells_of(1).cells) == CELLS


FAR = ("normals(radius=30.0)", "denoise(halo=30.0)")


def test_what_is_refused_costs_no_version(
    inner: Inner, made: DividedMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Finding the neighbours of a cell takes long."""
    monkeypatch.setattr(limits, "MAX_CELLS", 2 * CELLS - 1)
    one = inner(str(made.root))
    for message in (Area(1, EVERYWHERE, FAR), Differential(2, EVERYWHERE, FAR, packed=bytes(80))):
        with pytest.raises(BadRequest, match=f"more than {2 * CELLS - 1} cells"):
            one.ask(one.session(), message)
    assert len(list(one.cache.layers.unknown(range(CELLS), FAR))) == 2 * CELLS
    assert not one.loads.by_key


@short_turns
def test_one_version_of_layers_that_look_around_is_found_a_turn(inner: Inner, made: DividedMap) -> None:
    """Each once, however often they are asked for; after a change those that look into that cell."""
    one = inner(str(made.root))
    session, versions = one.session(), one.cache.layers
    one.pool.limit = 0

    def unknown() -> int:
        return len(list(versions.unknown(range(CELLS), FAR)))

    def found_a_turn(message: Differential) -> set[int]:
        left = [unknown(), *(unknown() for _ in one.cells.differential(session, message))]
        return {a - b for a, b in itertools.pairwise(left)}

    held = pack_versions(range(1, 100))
    assert found_a_turn(Differential(1, EVERYWHERE, FAR, packed=held)) == {0, 1}
    assert unknown() == 0
    assert found_a_turn(Differential(2, EVERYWHERE, FAR, packed=held)) == {0}
    assert len(one.cells_of(2).pending) == 2 * CELLS
    one.map_switch.learn(names_of(one).index("0_0.pcd"), bytes(24))
    assert unknown() == 2 * 5 * 5


def names_of(one: InnerDaemon) -> list[str]:
    return [one.cache.catalogue.id(index).rsplit("/", 1)[1] for index in range(CELLS)]


@short_turns
def test_the_map_changes_while_differences_are_found(inner: Inner, tmp_path: Path) -> None:
    made = make_map(tmp_path / "map", columns=SIDE, rows=SIDE, points=5)
    one = inner(str(made.root))
    held = tuple(HeldCell(cell.id) for cell in one.everything(999).cells)
    gone, left = sorted(made.corners), []
    for count in range(1, CELLS, CELLS // 12):
        work = one.cells.differential(one.session(), Differential(count, EVERYWHERE, held=held[1:]))
        for _ in range(count):
            next(work)
        left.append(gone.pop(1))
        del made.corners[left[-1]]  # every index after it is another one's now
        made.write_metadata()
        one.reload()
        finish(work)
        reply = one.cells_of(count)
        assert ([Path(cell).name for cell in reply.removed], names(reply)) == (left, gone[:1])


@short_turns
def test_very_much_is_released_in_several_turns(inner: Inner, made: DividedMap) -> None:
    one = inner(str(made.root))
    session = one.session()
    versions = [cell.version for cell in one.cells_for(Area(1, EVERYWHERE, wait=LONG_S), session).cells]
    assert len(session.held) == CELLS
    dispatch = Dispatch(*[None] * len(fields(Dispatch)))  # type: ignore[arg-type]
    dispatch.cells = one.cells
    dispatch.handshake = cast("Any", SimpleNamespace(sessions=one.sessions))
    work = dispatch._route(session.connection, Release(2, pack_versions(versions[1:])), b"") or ()
    assert [len(session.held) for _ in work] == list(range(CELLS, 1, -1))
    assert list(session.held) == versions[:1]
    assert one.replies[-1][1].request == 2


@short_turns
def test_what_came_for_another_client_meanwhile_is_not_loaded_again(inner: Inner, made: DividedMap) -> None:
    one = inner(str(made.root))
    session = one.session()
    work = one.cells.area(session, Area(1, EVERYWHERE, wait=LONG_S))
    for _ in range(CELLS + 5):  # found, and the first loads asked for
        next(work)
    assert len(one.cells_for(Area(2, EVERYWHERE, wait=LONG_S)).cells) == CELLS
    finish(work)
    assert len(one.cells_of(1).cells) == CELLS
    assert one.statistics.values["loads_started"] == CELLS


@short_turns
def test_a_session_that_ends_while_a_request_that_waited_is_answered(inner: Inner, made: DividedMap) -> None:
    """It is no defect of the daemon, and nothing stays of the request."""
    one = inner(str(made.root))
    refused: list[str] = []
    session = one.session()

    def refuse(request: int, error: ShmmapError) -> None:
        refused.append(error.code)

    session.connection.refuse = refuse  # type: ignore[method-assign]
    one.hold_answers = True
    one.ask(session, Area(1, EVERYWHERE, wait=LONG_S))
    one.run_until(lambda: one.due)
    next(one.due[0])
    one.sessions.close(session)
    finish(one.due[0])
    assert (refused, one.replies) == (["no_session"], [])
    one.run_until_nothing_waits()

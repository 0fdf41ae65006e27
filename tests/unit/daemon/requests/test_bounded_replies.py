# SPDX-License-Identifier: Apache-2.0
"""A reply has a bounded number of cells; a client goes on behind the last one, whatever the map does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from shmmap.daemon.requests import cell_requests, dispatch, limits
from shmmap.daemon.requests.dispatch import Dispatch
from shmmap.daemon.transport.sessions import Session
from shmmap.errors import BadRequest
from shmmap.layers.versions import LayerVersions
from shmmap.origin.catalogue import Catalogue
from shmmap.protocol.codec import pack_versions, unpack_versions
from shmmap.protocol.messages import Area, BoxMessage, Cells, Differential, Release, Selected
from tests.support.divided_map import DividedMap, make_map, random_points
from tests.unit.daemon.inner_daemon import EVERYWHERE, Inner, InnerDaemon, finish, joined, names

SIDE = 14
CELLS = SIDE * SIDE
LONG_S = 3000.0
"""Longer than a test waits for anything: no reply leaves early because the loads are slow."""
TWO = ("points", "voxel(leaf=1.0)")
FAR = ("normals(radius=30.0)", "denoise(halo=30.0)")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> DividedMap:
    return make_map(tmp_path_factory.mktemp("large") / "map", columns=SIDE, rows=SIDE, points=5)


@pytest.fixture
def small_replies(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bound replies so that some cells make many of them."""
    monkeypatch.setattr(cell_requests, "MAX_CELLS", 5)
    monkeypatch.setattr(cell_requests, "MAX_COLD", 3)


def test_cold_cells(inner: Inner, made: DividedMap) -> None:
    """Loads of one reply's cells begin with it; only the last reply waits, for its own."""
    one = inner(str(made.root))
    with one.loaders_standing_still():
        parts = one.parts_for(Area(1, EVERYWHERE))
        begun = [(len(part.pending), len(one.loads), bool(part.next)) for part in parts]
        assert begun == [(128, 128, True), (CELLS - 128, CELLS, False)]
        session = one.session()
        one.ask(session, Area(2, EVERYWHERE, wait=LONG_S))
        first = one.cells_of(2)
        assert (len(first.pending), len(one.cells)) == (128, 0)
        one.ask(session, Area(3, EVERYWHERE, wait=LONG_S, start=first.next))
        assert len(one.cells) == 1
    assert len(one.cells_of(3).cells) == CELLS - 128
    one.run_until_nothing_waits()


def test_warm_cells(inner: Inner, made: DividedMap) -> None:
    one = inner(str(made.root))
    layers = ("points", "voxel(leaf=1.0)", "crop(z_max=9.0)")
    whole = one.all_for(Area(1, EVERYWHERE, layers, LONG_S))
    assert len(whole.cells) == 3 * CELLS > cell_requests.MAX_CELLS
    for message in (Area(2, EVERYWHERE, layers), Differential(3, EVERYWHERE, layers)):
        parts = list(one.parts_for(message))
        assert [len(part.cells) <= cell_requests.MAX_CELLS + 2 for part in parts] == [True, True]
        assert joined(parts).cells == whole.cells
        ids = [cell.id for cell in parts[0].cells]
        assert parts[0].next == ids[-1]
        assert all(ids.count(cell) == 3 for cell in ids), "a cell's layers come together"


@pytest.mark.usefixtures("small_replies")
def test_start_may_be_anything(inner: Inner, small_map: DividedMap) -> None:
    one = inner(small_map.root)
    cells = names(one.everything())
    for start in ("", "0", "0_0.pcd", "0_0.pce", "~", one.cache.id_prefix + "0_0.pcd", "/", "/~", "\x00"):
        name = start if start.startswith("/") else one.cache.id_prefix + start
        behind = [cell for cell in cells if not start or one.cache.id_prefix + cell > name]
        for message in (Area(2, EVERYWHERE, start=start), Differential(3, EVERYWHERE, start=start)):
            one.replies.clear()
            assert names(one.cells_for(message)) == behind[:5], start


@pytest.mark.usefixtures("small_replies")
def test_a_bad_cell_holds_nothing_up(inner: Inner, small_map: DividedMap) -> None:
    """More cells that cannot be loaded than one reply has, at the front: those behind them come."""
    for name in sorted(small_map.corners)[:7]:
        Path(small_map.id(name)).write_bytes(b"no cloud")
    one = inner(small_map.root)
    for message in (Area(1, EVERYWHERE, wait=LONG_S), Differential(2, EVERYWHERE, wait=LONG_S)):
        whole = one.all_for(message)
        assert names(whole) == sorted(small_map.corners)[7:]
        assert len(whole.failed) == 7


def ids_of(reply: Cells) -> list[str]:
    return [cell.id for cell in reply.cells] + [cell.id for cell in reply.pending]


Change = Callable[[DividedMap, int], None]


def remove(made: DividedMap, number: int) -> None:
    made.remove_cell(sorted(made.corners)[number * 5 % len(made.corners)])


def add(made: DividedMap, number: int) -> None:
    corner = (-100 + 20 * (number * 7 % 9), 200)
    made.write_cell(
        f"{corner[0]}_{corner[1]}.pcd", corner, random_points(np.random.default_rng(9), corner, 9)
    )


def rewrite(made: DividedMap, number: int) -> None:
    name = sorted(made.corners)[number * 3 % len(made.corners)]
    corner = made.corners[name]
    made.write_cell(name, corner, random_points(np.random.default_rng(number), corner, 10 + number))


def state(one: InnerDaemon) -> dict[str, int]:
    """Version of each cell of the map, by name."""
    catalogue = one.cache.catalogue
    return {
        catalogue.id(index).rsplit("/", 1)[1]: catalogue.version(index) for index in range(len(catalogue))
    }


@pytest.mark.usefixtures("small_replies")
@pytest.mark.parametrize("change", [remove, add, rewrite])
@pytest.mark.parametrize("warm", [False, True])
def test_the_map_changes_between_any_two_replies(
    inner: Inner, small_map: DividedMap, change: Change, warm: bool
) -> None:
    """Each cell is as of one of the states; none that all have is left out, none comes twice."""
    one = inner(small_map.root)
    everything = one.everything(99) if warm else Cells(0, 0, 0)
    packed = pack_versions([cell.version for cell in everything.cells[::2]])
    held = {Path(cell.id).name: cell.version for cell in everything.cells[::2]}
    for message in (Area(1, EVERYWHERE), Differential(2, EVERYWHERE, packed=packed)):
        states = [state(one)]
        parts = []
        has = held if isinstance(message, Differential) else {}
        session = one.session()
        for number, part in enumerate(one.parts_for(message, session)):
            parts.append(part)
            if part.next:
                change(small_map, number)
                small_map.write_metadata()
                one.reload()
                states.append(state(one))
        whole = joined(parts)
        given = [Path(cell).name for cell in ids_of(whole)]
        assert len(parts) > 1
        assert whole.map_version == parts[0].map_version
        assert len({Path(cell.id).name for cell in whole.cells}) == len(whole.cells)
        in_all = set(states[0]).intersection(*states[1:])
        in_any = set().union(*states)
        lacked_by_all = {name for name in in_all if all(now[name] != has.get(name) for now in states)}
        assert lacked_by_all <= set(given) <= in_any
        assert not {name for name in given if all(now.get(name) == has.get(name) for now in states)}
        for cell in whole.cells:
            if not cell.stale:
                assert cell.version in [now.get(Path(cell.id).name) for now in states]
        assert all(part.removed_packed == b"" for part in parts[:-1])
        gone = {version for name, version in has.items() if name not in states[-1]}
        assert set(unpack_versions(parts[-1].removed_packed)) == gone
    one.run_until_nothing_waits()


@pytest.mark.usefixtures("small_replies")
def test_an_area_is_searched_once_for_all_its_replies(
    inner: Inner, small_map: DividedMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Unless the map changes, even if only one cell's file did, or another large area is asked for."""
    one = inner(small_map.root)
    one.everything(99)
    searched, query = [], Catalogue.query

    def counted(catalogue: Catalogue, *asked: Any) -> Any:
        searched.append(asked)
        return query(catalogue, *asked)

    monkeypatch.setattr(Catalogue, "query", counted)
    wanted: list[Area | Differential] = [
        Area(1, EVERYWHERE),
        Area(2, EVERYWHERE, TWO),
        Differential(3, EVERYWHERE, start="0_0.pcd"),
        Area(4, BoxMessage(-1e4, -1e4, 1e4, 1e4, -1e3, 1e3)),
    ]
    for message in wanted:
        one.all_for(message)
    assert len(searched) == 2, "an area with heights is another one"
    other = BoxMessage(-1e3, -1e3, 1e3, 1e3)
    for _ in zip(one.parts_for(Area(5, EVERYWHERE)), one.parts_for(Area(6, other)), strict=True):
        pass
    assert len(searched) > 6
    for change in (rewrite, add, remove):
        parts = one.parts_for(Area(7, EVERYWHERE))
        before = next(parts)
        change(small_map, 1)
        small_map.write_metadata()
        one.reload()
        known = [cell.id for cell in before.cells] + [cell for part in parts for cell in ids_of(part)]
        assert {Path(cell).name for cell in known} == {Path(cell).name for cell in small_map.corners}


def test_a_request_that_waits_is_found_again_in_the_map_as_it_is_then(
    inner: Inner, small_map: DividedMap
) -> None:
    one = inner(small_map.root)
    with one.loaders_standing_still():
        one.ask(one.session(), Area(1, EVERYWHERE, wait=LONG_S))
        add(small_map, 0)
        small_map.remove_cell("0_0.pcd")
        small_map.write_metadata()
        one.reload()
    assert names(one.cells_of(1)) == sorted(small_map.corners)
    one.run_until_nothing_waits()
    assert (one.statistics.values["hits"], one.statistics.values["misses"]) == (0, 16), "counted once"


@pytest.mark.parametrize("again", [1, 3, 9])
def test_cells_that_are_evicted_each_time(inner: Inner, small_map: DividedMap, again: int) -> None:
    """A request waits for them again, but not without bound."""
    one = inner(small_map.root)
    one.hold_answers = True
    one.ask(one.session(), Selected(1, ("0_0.pcd", "20_20.pcd"), wait=LONG_S))
    for _ in range(again):
        one.run_until(lambda: one.due)
        (resident, *_) = one.ledger.by_key.values()
        one.reclaimer.retire(resident, one.now_s())
        one.run_until(lambda: not one.ledger.retired)
        finish(one.due.pop())
        if one.replies:
            break
    one.hold_answers = False
    reply = one.cells_of(1)
    assert (len(reply.cells), len(reply.pending)) == (
        (2, 0) if again < cell_requests.MAX_ATTEMPTS else (1, 1)
    )
    one.run_until(lambda: not len(one.loads))
    one.run_until_nothing_waits()


def test_needed_until_it_is_answered(inner: Inner, small_map: DividedMap) -> None:
    one = inner(small_map.root)
    one.hold_answers = True
    one.ask(one.session(), Area(1, EVERYWHERE, wait=LONG_S))
    one.run_until(lambda: one.due)
    assert len(set(one.ledger.needed())) == 16
    finish(one.due.pop())
    assert len(one.cells_of(1).cells) == 16
    one.run_until_nothing_waits()


def test_what_a_client_is_given_is_noted_with_the_reply(inner: Inner, made: DividedMap) -> None:
    """Else a client that leaves at once, and keeps what it maps, would be known to no one."""
    one = inner(str(made.root))
    one.everything(999)
    session = one.session()
    one.ask(session, Area(1, EVERYWHERE))
    assert len(session.held) == CELLS


@pytest.mark.parametrize("ends", [False, True])
def test_nothing_stays_of_sessions_that_end(inner: Inner, made: DividedMap, ends: bool) -> None:
    """Whether their requests wait, or their answers are due."""
    one = inner(str(made.root))
    one.hold_answers = True
    sessions = [one.session() for _ in range(4)]
    for session in sessions:
        for number in range(30):
            one.ask(session, Area(1, BoxMessage(-130.0 + number, -130.0, 130.0, -20.0), wait=LONG_S))
    if ends:
        one.run_until(lambda: len(one.due) == 120)
    for session in sessions:
        one.sessions.close(session)
        one.cells.on_session_end(session)
    assert len(one.cells) == 0
    for due in one.due:
        finish(due)
    one.run_until(lambda: not len(one.loads))
    one.run_until_nothing_waits()
    assert one.replies == []


def test_what_is_refused_costs_no_version(
    inner: Inner, made: DividedMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Finding the neighbours of a cell takes long."""
    monkeypatch.setattr(limits, "MAX_CELLS", 2 * CELLS - 1)
    one = inner(str(made.root))
    monkeypatch.setattr(LayerVersions, "of_cells", None)
    for message in (Area(1, EVERYWHERE, FAR), Differential(2, EVERYWHERE, FAR, packed=bytes(80))):
        with pytest.raises(BadRequest, match=f"more than {2 * CELLS - 1} cells"):
            one.ask(one.session(), message)
    assert not one.loads.by_key


def test_few_versions_that_take_long_are_found_for_a_reply(
    inner: Inner, made: DividedMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each once, however often they are asked for."""
    one = inner(str(made.root))
    one.pool.limit = 0
    found, find = 0, LayerVersions._around

    def counted(versions: LayerVersions, index: int, halo_m: float) -> Any:
        nonlocal found
        found += 1
        return find(versions, index, halo_m)

    monkeypatch.setattr(LayerVersions, "_around", counted)
    held = pack_versions(range(1, 100))
    counts, before = [], 0
    for _ in one.parts_for(Differential(1, EVERYWHERE, FAR, packed=held)):
        counts.append(found - before)
        before = found
    assert max(counts) <= 64
    assert sum(counts) >= 2 * CELLS


def test_what_came_for_another_client_meanwhile_is_not_loaded_again(inner: Inner, made: DividedMap) -> None:
    one = inner(str(made.root))
    session, other = one.session(), one.session()
    for message in (Area(1, EVERYWHERE, wait=LONG_S), Differential(2, EVERYWHERE, wait=LONG_S)):
        list(zip(one.parts_for(message, session), one.parts_for(message, other), strict=False))
    assert len(one.everything(3).cells) == CELLS
    assert one.statistics.values["loads_started"] == CELLS


def test_very_much_is_released_in_several_steps(
    inner: Inner, made: DividedMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dispatch, "RELEASED_PER_STEP", 1)
    one = inner(str(made.root))
    session = one.session()
    versions = [cell.version for cell in one.all_for(Area(1, EVERYWHERE, wait=LONG_S), session).cells]
    assert len(session.held) == CELLS
    work = release(one, session, versions[1:])
    assert [len(session.held) for _ in work] == list(range(CELLS, 1, -1))
    assert list(session.held) == versions[:1]
    assert one.replies[-1][1].request == 9


def release(one: InnerDaemon, session: Session, versions: list[int]) -> Any:
    made = Dispatch(*[None] * len(fields(Dispatch)))  # type: ignore[arg-type]
    made.cells = one.cells
    made.handshake = cast("Any", SimpleNamespace(sessions=one.sessions))
    return made._route(session.connection, Release(9, pack_versions(versions)), b"") or ()

# SPDX-License-Identifier: Apache-2.0
"""No request asks for so much that others wait long for it, and no session keeps more than its quota."""

from __future__ import annotations

import math
import os
from pathlib import Path

import pytest

from shmmap.daemon.cache.holders import Holders
from shmmap.daemon.records import Resident
from shmmap.daemon.requests import limits
from shmmap.daemon.transport.sessions import Session
from shmmap.errors import BadRequest, Busy
from shmmap.layers import versions as layer_versions
from shmmap.protocol.messages import Area, Differential, HeldCell, Intent, Selected
from shmmap.segment.pins import lock_slot
from tests.support.divided_map import DividedMap, make_map
from tests.unit.daemon.inner_daemon import EVERYWHERE, Inner, InnerDaemon


def test_cells_of_one_request(inner: Inner, small_map: DividedMap, monkeypatch: pytest.MonkeyPatch) -> None:
    one = inner(small_map.root)
    monkeypatch.setattr(limits, "MAX_CELLS", 15)
    with pytest.raises(BadRequest, match="more than 15 cells in one request"):
        one.ask(one.session(), Area(1, EVERYWHERE))
    with pytest.raises(BadRequest, match="more than 15 cells"):  # known or not
        one.ask(one.session(), Selected(2, ("nowhere",) * 16))
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
        one.ask(greedy, Area(1, EVERYWHERE))
        assert len(one.cells_of(1).pending) == 16
        one.ask(greedy, Area(2, EVERYWHERE))
        assert len(one.cells_of(2).pending) == 16
        with pytest.raises(Busy, match="5 loads"):
            one.ask(greedy, Area(3, EVERYWHERE, ("voxel(leaf=1.0)",)))
        one.ask(other, Area(4, EVERYWHERE, ("voxel(leaf=1.0)",)))
        assert len(one.cells_of(4).pending) == 16
    one.run_until(lambda: not len(one.loads))
    one.ask(greedy, Area(5, EVERYWHERE, ("voxel(leaf=2.0)",), 30.0))
    assert len(one.cells_of(5).cells) == 16


def test_layers(inner: Inner, small_map: DividedMap) -> None:
    one = inner(small_map.root)
    session = one.session()
    with pytest.raises(BadRequest, match="17 layers in one request"):
        one.ask(session, Area(1, EVERYWHERE, ("points",) * 17))


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
    many.ask(session, Selected(1, ids(many, 0, 50), wait=30.0))
    cells = many.cells_of(1).cells
    opened = [os.open(many.path_of(cell.segment), os.O_RDONLY) for cell in cells] if map_them else []
    for fd in opened:
        lock_slot(fd, session.slot)
    many.cells._quota.nbytes = session.held_bytes
    many.offset_s += 2.0
    return session, opened


@pytest.mark.usefixtures("short_turns")
def test_a_few_looks_a_turn(many: InnerDaemon, monkeypatch: pytest.MonkeyPatch) -> None:
    """It holds 50 and maps none: enough of them are dropped for what it asks for now, the oldest first."""
    looks, look = 0, Holders.has

    def counted(holders: Holders, resident: Resident, slot: int) -> bool:
        nonlocal looks
        looks += 1
        return look(holders, resident, slot)

    monkeypatch.setattr(Holders, "has", counted)
    session, _ = full(many)
    before = 0
    for _ in many.cells.selected(session, Selected(2, ids(many, 50, 60) + ids(many, 0, 8), wait=30.0)):
        assert looks - before <= 1
        before = looks
    assert len(many.cells_of(2).cells) == 18
    assert many.statistics.values["refused_quota"] == 0
    assert 10 <= looks < 50
    assert {r.key.cell_id for r in session.residents()} >= set(ids(many, 30, 60))


def test_what_it_still_maps_counts(many: InnerDaemon) -> None:
    """It is refused what is too much."""
    session, opened = full(many, map_them=True)
    many.ask(session, Selected(2, ids(many, 45, 60), wait=30.0))
    reply = many.cells_of(2)
    assert len(reply.cells) + len(reply.failed) == 15
    assert {failure.code for failure in reply.failed} == {"over_budget"}
    assert many.statistics.values["refused_quota"] == len(reply.failed) > 0
    for fd in opened:
        os.close(fd)
    many.ask(session, Selected(4, ids(many, 50, 60), wait=30.0))
    assert len(many.cells_of(4).cells) == 10

# SPDX-License-Identifier: Apache-2.0
"""Before a session is refused something, it is looked up what it has released: some segments a turn."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from shmmap.daemon.cache.holders import Holders
from shmmap.daemon.records import Resident
from shmmap.daemon.transport.sessions import Session
from shmmap.protocol.messages import Selected
from shmmap.segment.pins import lock_slot
from tests.support.divided_map import make_map
from tests.unit.daemon.inner_daemon import Inner, InnerDaemon


@pytest.fixture
def one(inner: Inner, tmp_path: Path) -> InnerDaemon:
    """Return a daemon of 60 cells."""
    return inner(make_map(tmp_path / "map", columns=10, rows=6, points=10).root)


def ids(one: InnerDaemon, first: int, last: int) -> tuple[str, ...]:
    return tuple(one.cache.catalogue.id(index) for index in range(first, last))


def full(one: InnerDaemon, *, map_them: bool = False) -> tuple[Session, list[int]]:
    """Return a session that was handed 50 cells, which is all that it may keep; descriptors of them."""
    session = one.session()
    one.ask(session, Selected(1, ids(one, 0, 50), wait=30.0))
    cells = one.cells_of(1).cells
    opened = [os.open(one.path_of(cell.segment), os.O_RDONLY) for cell in cells] if map_them else []
    for fd in opened:
        lock_slot(fd, session.slot)
    one.cells._quota.nbytes = session.held_bytes
    one.offset_s += 2.0
    return session, opened


@pytest.mark.usefixtures("short_turns")
def test_a_few_looks_a_turn(one: InnerDaemon, monkeypatch: pytest.MonkeyPatch) -> None:
    """It holds 50 and maps none: enough of them are dropped for what it asks for now, the oldest first."""
    looks, look = 0, Holders.has

    def counted(holders: Holders, resident: Resident, slot: int) -> bool:
        nonlocal looks
        looks += 1
        return look(holders, resident, slot)

    monkeypatch.setattr(Holders, "has", counted)
    session, _ = full(one)
    before = 0
    for _ in one.cells.selected(session, Selected(2, ids(one, 50, 60) + ids(one, 0, 8), wait=30.0)):
        assert looks - before <= 1
        before = looks
    assert len(one.cells_of(2).cells) == 18
    assert one.statistics.values["refused_quota"] == 0
    assert 10 <= looks < 50
    assert {r.key.cell_id for r in session.residents()} >= set(ids(one, 30, 60))


def test_what_it_still_maps_counts(one: InnerDaemon) -> None:
    """It is refused what is too much."""
    session, opened = full(one, map_them=True)
    one.ask(session, Selected(2, ids(one, 45, 60), wait=30.0))
    reply = one.cells_of(2)
    assert len(reply.cells) + len(reply.failed) == 15
    assert {failure.code for failure in reply.failed} == {"over_budget"}
    assert one.statistics.values["refused_quota"] == len(reply.failed) > 0
    for fd in opened:
        os.close(fd)
    one.ask(session, Selected(4, ids(one, 50, 60), wait=30.0))
    assert len(one.cells_of(4).cells) == 10

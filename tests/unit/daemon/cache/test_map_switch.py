# SPDX-License-Identifier: Apache-2.0
"""Another state of the map is served at once; what is in memory is looked at some segments a turn."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from shmmap.daemon.cache import map_switch
from shmmap.daemon.cache.warm_index import Heights
from shmmap.protocol.codec import pack_versions
from shmmap.protocol.messages import Area, CircleMessage, Differential, Metadata
from tests.support.divided_map import DividedMap, make_map
from tests.unit.daemon.inner_daemon import EVERYWHERE, Inner, InnerDaemon, names

SIDE = 8
CELLS = SIDE * SIDE


@pytest.fixture
def made(tmp_path: Path) -> DividedMap:
    return make_map(tmp_path / "map", columns=SIDE, rows=SIDE, points=5)


def finish_change(one: InnerDaemon) -> None:
    """Do the rest of a change."""
    while one.map_switch.busy:
        one.map_switch.run_step(one.now_s())


def remove(made: DividedMap, name: str) -> None:
    del made.corners[name]
    made.write_metadata()


@pytest.mark.parametrize("turns", [0, 1, CELLS // 2, CELLS + 3])
@pytest.mark.usefixtures("short_turns")
def test_requests_meanwhile_are_answered_as_if_it_were_over(
    inner: Inner, made: DividedMap, turns: int
) -> None:
    """Nothing is loaded again, nothing that left is handed out, and what is held is not sent again."""
    one = inner(str(made.root))
    held = pack_versions([cell.version for cell in one.everything().cells])
    loads = one.statistics.values["loads_started"]
    remove(made, "0_0.pcd")
    made.change("20_20.pcd", 3)
    one.reload()
    for _ in range(turns):
        one.map_switch.run_step(one.now_s())
    one.ask(one.session(), Differential(2, EVERYWHERE, packed=held, wait=30.0))
    reply = one.cells_of(2)
    assert names(reply) == ["20_20.pcd"]
    assert len(reply.removed_packed) == 8  # of the cell that left; the changed one is replaced
    assert len(one.everything(3).cells) == CELLS - 1
    assert one.statistics.values["loads_started"] == loads + 1
    finish_change(one)
    assert one.cache.unentered == 0
    one.ask(one.session(), Area(4, CircleMessage(1, 1, 2)))
    assert "0_0.pcd" not in names(one.cells_of(4))
    assert one.ledger.resident_count == CELLS - 1


@pytest.mark.usefixtures("short_turns")
def test_a_change_during_a_change(inner: Inner, made: DividedMap) -> None:
    one = inner(str(made.root))
    one.everything()
    for name in sorted(made.corners)[:5]:
        remove(made, name)
        one.reload()
        one.map_switch.run_step(one.now_s())
    finish_change(one)
    assert len(one.cache.warm) == one.ledger.resident_count == CELLS - 5
    assert len(one.everything(2).cells) == CELLS - 5


def test_very_many_changes_are_not_remembered(
    inner: Inner, made: DividedMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Then the whole list is answered; fewer changes are named, also of several states."""
    monkeypatch.setattr(map_switch, "CELLS_REMEMBERED", 5)
    one = inner(str(made.root))
    first = one.cache.catalogue.map_version
    some = sorted(made.corners)[:6]
    for name in some[:3]:
        made.change(name, 3)
    one.reload()
    second = one.cache.catalogue.map_version
    made.change(some[3], 3)
    one.reload()
    page = one.queries.page(Metadata(1, since=first))
    assert [row.id for row in page.rows] == some[:4]  # type: ignore[union-attr]
    for name in some[4:]:
        made.change(name, 4)
    one.reload()
    assert one.map_switch.changes_since(first) is None
    assert one.map_switch.changes_since(second) is not None
    for name in some:
        made.change(name, 5)
    one.reload()
    assert one.map_switch.changes_since(second) is None
    everything = one.queries.page(Metadata(2, since=first))
    assert (len(everything.rows), everything.since_known) == (CELLS, False)  # type: ignore[union-attr]


def test_heights() -> None:
    heights = Heights(5)
    heights.learn(1, -1.0, 2.0)
    heights.learn(2, 5.0, 6.0)
    heights.learn(3, np.nan, np.nan)  # of a layer without heights
    heights.learn(4, 5.0, 6.0)
    heights.forget(np.array([4]))
    assert (heights.get(1), heights.get(0), heights.get(4)) == ((-1.0, 2.0), None, None)
    assert heights.overlapping([4, 3, 2, 1, 0], (2.0, 4.0)) == [4, 3, 1, 0]

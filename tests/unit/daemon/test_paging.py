# SPDX-License-Identifier: Apache-2.0
"""A map of which part is not known yet: the whole daemon behind a view that comes in pages."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shmmap import AutowareSquare, Box, HeldCell, MapWindow, Offline, connect
from shmmap.origin.map_directory import open_map
from shmmap.protocol import messages as m
from shmmap.protocol.codec import pack_versions, unpack_versions
from tests.support.divided_map import DividedMap
from tests.unit.daemon.paging_view import PagingOrigin
from tests.unit.daemon.whole_daemon import WholeDaemon

WEST, EAST = 0, 1
PAGES = np.array([[-40.0, -40.0, 0.0, 40.0], [0.0, -40.0, 40.0, 40.0]])
EVERYWHERE = m.BoxMessage(-35.0, -35.0, 35.0, 35.0)
IN_THE_WEST = m.BoxMessage(-35.0, -35.0, -5.0, 35.0)
IN_THE_EAST = m.BoxMessage(5.0, -35.0, 35.0, 35.0)


def names(cells: Any) -> list[str]:
    return [Path(cell.id).name for cell in cells]


def columns(*corners: int) -> list[str]:
    """Names of the cells whose left borders are these, in id order."""
    return sorted(f"{x}_{y}.pcd" for x in corners for y in (-40, -20, 0, 20))


ALL = columns(-40, -20, 0, 20)
KNOWN_IN_THE_WEST = columns(-40, -20, 0)  # borders are closed: the page ends where a column begins


@dataclass
class Paged:
    """A daemon, and what its map comes from."""

    daemon: WholeDaemon
    origin: PagingOrigin
    requests: int = 100

    def ask(self, request: Callable[[int], m.Request]) -> Any:
        self.requests += 1
        return self.daemon.ask(request(self.requests))

    def know(self, *pages: int) -> None:
        """The daemon learns, or in another life has yet to learn, which cells these pages have."""
        self.origin.known = set(pages)
        assert isinstance(self.ask(m.Reload), m.Reloaded)


@pytest.fixture
def paged(whole: Callable[..., WholeDaemon], small_map: DividedMap, tmp_path: Path) -> Paged:
    origin = PagingOrigin(open_map(str(small_map.root), cache_dir=str(tmp_path)).load(), PAGES, {WEST})
    return Paged(whole(small_map.root, origin=origin), origin)


def test_what_is_known_comes_and_the_reply_says_that_more_may(paged: Paged) -> None:
    reply = paged.ask(lambda n: m.Area(n, IN_THE_WEST, wait=30.0))
    assert (names(reply.cells), reply.covered) == (columns(-40, -20), True)
    reply = paged.ask(lambda n: m.Area(n, EVERYWHERE, wait=30.0))
    assert (names(reply.cells), reply.covered) == (KNOWN_IN_THE_WEST, False)
    paged.know(WEST, EAST)
    reply = paged.ask(lambda n: m.Area(n, EVERYWHERE, wait=30.0))
    assert (names(reply.cells), reply.covered) == (ALL, True)
    assert paged.ask(lambda n: m.Area(n, EVERYWHERE)).covered, "warm, too"


@pytest.mark.parametrize(
    ("before", "after", "listed"),
    [
        pytest.param({WEST}, {WEST, EAST}, KNOWN_IN_THE_WEST, id="more is known"),
        pytest.param({WEST, EAST}, {WEST}, KNOWN_IN_THE_WEST, id="less is known"),
    ],
)
def test_what_is_known_changes_while_a_request_waits(
    paged: Paged, monkeypatch: pytest.MonkeyPatch, before: set[int], after: set[int], listed: list[str]
) -> None:
    """Its reply has the cells that were known all the time, and says that more may be there."""
    daemon, request = paged.daemon, m.Area(50, EVERYWHERE, wait=30.0)
    paged.know(*before)
    with monkeypatch.context() as patch:
        patch.setattr(type(daemon.memory.scheduler.pool), "submit", lambda *_, **__: False)
        daemon.send(request)
        daemon.turn_until(lambda: len(daemon.service._loop.cells))
        version, paged.origin.known = daemon.memory.cache.catalogue.map_version, after
        daemon.service._reload()
        daemon.turn_until(lambda: daemon.memory.cache.catalogue.map_version != version)
    daemon.turn_until(daemon.answered)
    reply = daemon.received()
    assert (names(reply.cells), reply.covered) == (listed, False)


@pytest.mark.parametrize("by_name", [False, True])
def test_nothing_that_may_lie_in_the_unknown_part_is_removed(paged: Paged, by_name: bool) -> None:
    paged.know(WEST, EAST)
    held = paged.ask(lambda n: m.Area(n, EVERYWHERE, wait=30.0)).cells
    version_of = {Path(cell.id).name: cell.version for cell in held}
    strange = 12345

    def differential(n: int) -> m.Differential:
        named = tuple(HeldCell(name, version) for name, version in version_of.items())
        if by_name:
            return m.Differential(n, IN_THE_EAST, held=(*named, HeldCell("nowhere.pcd", strange)))
        return m.Differential(n, IN_THE_EAST, packed=pack_versions([*version_of.values(), strange]))

    def removed(reply: m.Cells) -> list[str]:
        name_of = {version: name for name, version in version_of.items()} | {strange: "nowhere.pcd"}
        return sorted([*reply.removed, *(name_of[v] for v in unpack_versions(reply.removed_packed))])

    paged.know(WEST)  # as after a restart of the daemon
    reply = paged.ask(differential)
    assert not reply.covered
    assert removed(reply) == columns(-40, -20), "known, and outside of the area"
    assert reply.cells == ()
    paged.know(WEST, EAST)
    reply = paged.ask(differential)
    assert reply.covered
    assert removed(reply) == sorted([*columns(-40, -20), "nowhere.pcd"])
    again = {*names(reply.cells)}
    assert again == set(), "who kept the cells lacks nothing"


def test_an_id_that_is_not_known_may_be_somewhere(paged: Paged) -> None:
    for ids, covered, failed in (
        (("-40_-40.pcd",), True, []),
        (("-40_-40.pcd", "20_20.pcd"), False, ["20_20.pcd"]),
    ):
        reply = paged.ask(lambda n, ids=ids: m.Selected(n, ids, wait=30.0))  # type: ignore[misc]
        assert (reply.covered, [one.id for one in reply.failed]) == (covered, failed)
        assert {one.code for one in reply.failed} <= {"unknown_cell"}
    paged.know(WEST, EAST)
    reply = paged.ask(lambda n: m.Selected(n, ("20_20.pcd", "nowhere.pcd"), wait=30.0))
    assert (reply.covered, [one.id for one in reply.failed]) == (True, ["nowhere.pcd"])


def test_what_became_known_since_a_map_version(paged: Paged) -> None:
    """The list of cells is that of a map version: what is known by then."""
    before = paged.ask(m.Metadata)
    assert names(before.rows) == KNOWN_IN_THE_WEST
    paged.know(WEST, EAST)
    more = paged.ask(lambda n: m.Metadata(n, since=before.map_version))
    assert more.map_version != before.map_version
    assert (names(more.rows), more.since_known, more.removed) == (columns(20), True, ())


def test_the_client_library_says_so(paged: Paged) -> None:
    with paged.daemon.turning(), connect(paged.daemon.endpoint) as client:
        found = client.area(
            Box(-35.0, -35.0, 35.0, 35.0), ["voxel( 1 )", "points", "voxel(leaf=1.0)"], wait=60.0
        )
        assert (found.covered, found.complete) == (False, False)
        assert found.layers == ("voxel(leaf=1.0)", "points", "voxel(leaf=1.0)")
        assert (len(found), found.failed, found.pending) == (24, (), ())
        found = client.area(Box(-35.0, -35.0, -5.0, 35.0), wait=60.0)
        assert (found.covered, found.complete, found.layers) == (True, True, ("points",))


@pytest.mark.parametrize("background", [True, False])
def test_a_window_keeps_what_may_be_in_the_unknown_part(paged: Paged, background: bool) -> None:
    with (
        paged.daemon.turning(),
        connect(paged.daemon.endpoint) as operator,
        MapWindow(
            paged.daemon.endpoint, 38.0, shape="square", update_distance=0.5, background=background
        ) as window,
    ):

        def know(*pages: int) -> None:
            paged.origin.known = set(pages)
            operator.reload()

        know(WEST, EAST)
        window.move_to(0.0, 0.0, wait=30.0)
        assert window.wait_until_current(30.0)
        assert (names(window.cells), window.complete) == (ALL, True)
        assert window.covers(0.0, 0.0, 30.0)
        know(WEST)
        update = window.move_to(1.0, 0.0, wait=1.0)  # far enough to be asked again
        assert (update.removed, update.covered, update.complete) == ((), False, False)
        assert (names(window.cells), window.complete) == (ALL, False)
        assert not window.covers(1.0, 0.0, 1.0), "nobody knows where the unknown cells lie"
        assert not window.points_around(1.0, 0.0, 1.0).covered
        assert not window.wait_until_current(0.05)
        know(WEST, EAST)
        update = window.move_to(1.0, 0.0, wait=30.0)
        assert window.wait_until_current(30.0)
        assert (names(window.cells), window.complete) == (ALL, True)
        assert not update.removed


def test_an_origin_out_of_reach_does_not_change_the_map(paged: Paged) -> None:
    paged.origin.offline = True
    with paged.daemon.turning(), connect(paged.daemon.endpoint) as client:
        with pytest.raises(Offline, match="does not answer") as refused:
            client.reload()
        assert refused.value.exit_code == 75
        assert len(client.area(AutowareSquare(0.0, 0.0, 38.0))) == len(KNOWN_IN_THE_WEST)

# SPDX-License-Identifier: Apache-2.0
"""A map whose list of cells comes page by page: the whole daemon behind a partial catalogue."""

from __future__ import annotations

import math
import random
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from shmmap import AutowareSquare, Box, MapWindow, Offline, connect
from shmmap.daemon.loading.loads import PREFETCH
from shmmap.daemon.map.catalogue_view import Ready
from shmmap.daemon.requests import limits, map_queries
from shmmap.daemon.requests.operators import operator_requests
from shmmap.daemon.requests.paging import Paging
from shmmap.layers.versions import LayerVersions
from shmmap.origin.map_directory import open_map
from shmmap.protocol import events
from shmmap.protocol import messages as m
from shmmap.protocol.codec import pack_versions, unpack_versions
from shmmap.protocol.messages import HeldCell
from tests.support.cpp_client import CppClient
from tests.support.divided_map import DividedMap
from tests.support.skips import open3d_or_skip
from tests.unit.daemon.paging_view import MemoryPages, PagedOrigin, PagedView
from tests.unit.daemon.whole_daemon import WholeDaemon

WEST, EAST = 0, 1
PAGES = np.array([[-40.0, -40.0, 0.0, 40.0], [0.0, -40.0, 40.0, 40.0]])
EVERYWHERE = m.BoxMessage(-35.0, -35.0, 35.0, 35.0)
IN_THE_WEST = m.BoxMessage(-35.0, -35.0, -5.0, 35.0)
LONG_S = 200.0
HALO = "denoise"


def names(cells: Any) -> list[str]:
    return [Path(cell.id).name for cell in cells]


def columns(*corners: int) -> list[str]:
    """Names of the cells whose left borders are these, in id order."""
    return sorted(f"{x}_{y}.pcd" for x in corners for y in (-40, -20, 0, 20))


ALL, WESTERN, EASTERN = columns(-40, -20, 0, 20), columns(-40, -20), columns(0, 20)


@dataclass
class Paged:
    """A daemon, and what its map comes from."""

    daemon: WholeDaemon
    origin: PagedOrigin
    directory: DividedMap
    cache_dir: str
    requests: int = 100

    @property
    def view(self) -> PagedView:
        return cast("PagedView", self.daemon.memory.cache.catalogue)

    @property
    def pages(self) -> MemoryPages:
        return self.view.pages

    @property
    def paging(self) -> Paging:
        found = [task for _, task in self.daemon.service._loop.tasks if isinstance(task, Paging)]
        return found[0]

    def count(self, name: str) -> int:
        return self.daemon.memory.statistics.values[name]

    def ask(self, request: Callable[[int], m.Request]) -> Any:
        self.requests += 1
        return self.daemon.ask(request(self.requests))

    def begin(self, request: Callable[[int], m.Request]) -> None:
        """Send a request that waits, and turn until it does."""
        self.requests += 1
        waiting = len(self.daemon.service._loop.cells)
        self.daemon.send(request(self.requests))
        self.daemon.turn_until(lambda: len(self.daemon.service._loop.cells) > waiting)

    def answer(self) -> Any:
        self.daemon.turn_until(self.daemon.answered)
        return self.daemon.received()

    def know(self, *pages: int) -> None:
        """Let the daemon know these pages, and forget all others, as if they had been given up."""
        for page in set(self.pages.needed) - set(pages):
            self.pages.drop(page)
        self.pages.come(*(page for page in pages if not self.pages.is_here(page)))
        self.daemon.turn_until(lambda: set(self.pages.needed) == set(pages))

    def let_come(self, chance: random.Random, failing: float = 0.0) -> None:
        """Let one of the pages come that are wanted, of this state of the map or the next; or fail."""
        for view in {id(one): one for one in (self.view, self.origin.last) if one is not None}.values():
            pages = view.pages
            if pages.wanted and pages.settled:
                page = chance.choice(sorted(pages.wanted))
                fails = chance.random() < failing and not pages.is_out_of_reach(page)
                (pages.fail if fails else pages.come)(page)

    def give_up(self, most: int) -> None:
        """Let the daemon drop pages until no more than ``most`` are here, or all are needed."""
        self.pages.most, looked = most, 2 * len(self.pages.needed)
        is_needed = self.paging.is_needed
        while self.pages.spare() is not None and (looked := looked - 1):
            self.paging.run_step(math.inf)
            self.paging._rests_until_s = -math.inf
        assert len(self.pages.needed) <= most or any(map(is_needed, self.pages.needed))
        self.pages.most = len(self.pages)

    def next_version(self) -> None:
        """Have the origin serve the map as it is on the disk now, once it is asked again."""
        self.origin.whole = open_map(str(self.directory.root), cache_dir=self.cache_dir).load()

    def read_again(self) -> None:
        self.next_version()
        assert isinstance(self.ask(m.Reload), m.Reloaded)


@pytest.fixture
def in_pages(
    whole: Callable[..., WholeDaemon], small_map: DividedMap, tmp_path: Path
) -> Callable[..., Paged]:
    """Serve a map in pages: ``in_pages(boxes, known)``."""

    def serve(boxes: NDArray[np.float64], known: set[int]) -> Paged:
        origin = PagedOrigin(open_map(str(small_map.root), cache_dir=str(tmp_path)).load(), boxes, known)
        return Paged(whole(small_map.root, origin=origin), origin, small_map, str(tmp_path))

    return serve


@pytest.fixture
def paged(in_pages: Callable[..., Paged]) -> Paged:
    return in_pages(PAGES, {WEST})


# --- requests for cells ----------------------------------------------------------------------------


def test_without_waiting_what_is_known_comes_and_the_reply_says_that_more_may(paged: Paged) -> None:
    reply = paged.ask(lambda n: m.Area(n, IN_THE_WEST, wait=LONG_S))
    assert (names(reply.cells), reply.covered, reply.reason) == (WESTERN, True, "")
    assert paged.pages.wanted == {}
    reply = paged.ask(lambda n: m.Area(n, EVERYWHERE))
    assert paged.pages.wanted == {EAST: 0.0}
    assert (names(reply.cells), reply.covered, reply.reason) == (WESTERN, False, "")
    paged.know(WEST, EAST)
    reply = paged.ask(lambda n: m.Area(n, EVERYWHERE, wait=LONG_S))
    assert (names(reply.cells), reply.covered) == (ALL, True)
    assert paged.ask(lambda n: m.Area(n, EVERYWHERE)).covered, "warm, too"


def test_pages_come_one_after_the_other(in_pages: Callable[..., Paged]) -> None:
    """Of four, in any order; the request is answered with the last one."""
    quarters = np.array([[x, y, x + 40.0, y + 40.0] for x in (-40.0, 0.0) for y in (-40.0, 0.0)])
    one = in_pages(quarters, set())
    one.begin(lambda n: m.Area(n, EVERYWHERE, wait=LONG_S))
    for number, page in enumerate((2, 0, 3), 1):
        one.pages.come(page)
        one.daemon.turn_until(lambda n=number: one.count("loads_finished") == 4 * n)  # type: ignore[misc]
        assert not one.daemon.answered()
    one.pages.come(1)
    reply = one.answer()
    assert (names(reply.cells), reply.covered) == (ALL, True), "in id order, whatever the pages'"


def test_another_state_of_the_map_while_a_request_waits_for_a_page(paged: Paged) -> None:
    paged.begin(lambda n: m.Area(n, EVERYWHERE, wait=LONG_S))
    paged.directory.remove_cell("20_20.pcd")
    paged.directory.change("-40_0.pcd", 5)
    paged.directory.write_metadata()
    paged.next_version()
    before = paged.view.map_version
    paged.daemon.service._reload()
    paged.daemon.turn_until(lambda: paged.view.map_version != before)
    assert not paged.daemon.answered()
    paged.pages.come(EAST)
    reply = paged.answer()
    assert names(reply.cells) == [name for name in ALL if name != "20_20.pcd"]
    assert (reply.covered, reply.map_version) == (True, paged.view.map_version)


def test_an_area_is_refused_by_the_pages_that_lie_wholly_in_it(
    paged: Paged, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before any of them has come."""
    monkeypatch.setattr(limits, "MAX_CELLS", 12)
    everything = m.BoxMessage(-100.0, -100.0, 100.0, 100.0)
    reply = paged.ask(lambda n: m.Area(n, everything, wait=LONG_S))
    assert isinstance(reply, m.ErrorReply)
    assert reply.code == "bad_request"
    assert paged.pages.wanted == {}
    assert names(paged.ask(lambda n: m.Area(n, IN_THE_WEST, wait=LONG_S)).cells) == WESTERN


def test_an_id_that_is_not_known_may_be_somewhere(paged: Paged) -> None:
    for ids, covered, failed in (
        (("-40_-40.pcd",), True, []),
        (("-40_-40.pcd", "20_20.pcd"), False, ["20_20.pcd"]),
    ):
        reply = paged.ask(lambda n, ids=ids: m.Selected(n, ids, wait=LONG_S))  # type: ignore[misc]
        assert (reply.covered, [one.id for one in reply.failed]) == (covered, failed)
        assert {one.code for one in reply.failed} <= {"unknown_cell"}
    shown = paged.ask(lambda n: m.Show(n, "20_20.pcd"))
    assert (shown.code, "not all of the map is known" in shown.hint) == ("unknown_cell", True)
    assert paged.ask(lambda n: m.Pin(n, ("-40_-40.pcd", "20_20.pcd"))).unknown == ("20_20.pcd",)
    paged.know(WEST, EAST)
    reply = paged.ask(lambda n: m.Selected(n, ("20_20.pcd", "nowhere.pcd"), wait=LONG_S))
    assert (reply.covered, [one.id for one in reply.failed]) == (True, ["nowhere.pcd"])


def _touches(area: m.CircleMessage, box: tuple[float, float, float, float]) -> bool:
    dx = max(box[0] - area.x, area.x - box[2], 0.0)
    dy = max(box[1] - area.y, area.y - box[3], 0.0)
    return dx * dx + dy * dy <= area.radius * area.radius


STRIPS = np.array([[x, y, x + 40.0, y + 20.0] for x in (-40.0, 0.0) for y in (-40.0, -20.0, 0.0, 20.0)])


def difference(
    number: int, area: m.CircleMessage, held: dict[str, int], chance: random.Random, **more: Any
) -> m.Differential:
    """Ask for an area; what is held is named, or packed."""
    if chance.random() < 0.5:
        return m.Differential(
            number, area, held=tuple(HeldCell(name, version) for name, version in held.items()), **more
        )
    return m.Differential(number, area, packed=pack_versions(held.values()), **more)


def removed(reply: m.Cells, held: dict[str, int]) -> set[str]:
    """Return what of it is to be dropped."""
    of_version = {version: name for name, version in held.items()}
    return {*reply.removed, *(of_version[version] for version in unpack_versions(reply.removed_packed))}


@pytest.mark.parametrize("layer", ["points", HALO])
def test_along_a_drive_a_waiting_request_has_all_that_can_be_reached(
    in_pages: Callable[..., Paged], layer: str
) -> None:
    """Pages come in any order while it waits, some cannot be had, and the map may change meanwhile."""
    if layer == HALO:
        open3d_or_skip()
    chance = random.Random(7)
    one = in_pages(STRIPS, set())
    held: dict[str, int] = {}
    reasons: list[str] = []
    for step in range(40):
        if chance.random() < 0.3:
            one.ask(m.Evict)
            held = {}
            one.give_up(0)
        area = m.CircleMessage(chance.uniform(-40, 40), chance.uniform(-40, 40), chance.uniform(5, 30))
        one.requests += 1
        one.daemon.send(difference(one.requests, area, held, chance, layers=(layer,), wait=LONG_S))
        changes = layer == "points" and chance.random() < 0.15
        while not one.daemon.answered():
            one.daemon.turn()
            one.let_come(chance, failing=0.7)
            if changes and len(one.daemon.service._loop.cells):
                changes = False
                one.directory.change(chance.choice(ALL), step)
                one.next_version()
                one.daemon.service._reload()
        reply = one.daemon.received()
        if reply.map_version != one.origin.whole.map_version:
            held = {}  # nothing to compare with: the state that it is of is gone
            while one.view.map_version != one.origin.whole.map_version:
                one.daemon.turn()
                one.let_come(chance)
            continue
        reasons.append(reply.reason)
        assert reply.pending == ()
        assert {failed.code for failed in reply.failed} <= {"offline"}
        lost = {failed.id for failed in reply.failed}
        versions = LayerVersions(lambda: one.origin.whole)
        index_of = {name: one.origin.whole.find(name) for name in ALL}
        current = {name: versions.version(i, layer) for name, i in index_of.items() if i is not None}
        inside = {
            name for name, i in index_of.items() if i is not None and _touches(area, one.origin.whole.box(i))
        }
        fresh = {cell.id: cell.version for cell in reply.cells}
        assert fresh == {name: current[name] for name in fresh}
        if reply.covered:
            assert set(fresh) | lost == {name for name in inside if held.get(name) != current[name]}
            assert removed(reply, held) == {name for name in held if name not in inside}
        else:
            assert reply.reason == "offline"
            assert set(fresh) | lost <= inside
            assert not inside & removed(reply, held)
        held = {name: v for name, v in held.items() if name not in removed(reply, held)} | fresh
    assert reasons.count("") > 10
    assert "offline" in reasons


# --- within one version ----------------------------------------------------------------------------


def test_a_page_that_comes_is_no_other_state_of_the_map(paged: Paged) -> None:
    reply = paged.ask(lambda n: m.Area(n, IN_THE_WEST, wait=LONG_S))
    cache, statistics = paged.daemon.memory.cache, paged.daemon.memory.statistics
    warm, before = cache.warm, {name: statistics.values[name] for name in ("reloads", "evictions")}
    first = paged.ask(lambda n: events.Recent(n, after=0)).next
    version, segments = paged.view.map_version, {cell.segment for cell in reply.cells}
    welcome = paged.ask(lambda n: m.Hello(n, *m.PROTOCOL_VERSION, "again"))
    assert (welcome.cells, welcome.bounds) == (16, (-40.0, -40.0, 40.0, 40.0)), "those of the whole map"
    paged.know(WEST, EAST)
    reply = paged.ask(lambda n: m.Area(n, EVERYWHERE, wait=LONG_S))
    assert segments < {cell.segment for cell in reply.cells}
    assert (cache.warm is warm, paged.view.map_version) == (True, version)
    assert {name: statistics.values[name] for name in before} == before
    recent = paged.ask(lambda n: events.Recent(n, after=first - 1)).events
    assert {type(events.decode_event(one)) for one in recent} <= {events.Loaded, events.PrefetchMiss}
    since = paged.ask(lambda n: m.Metadata(n, since=version))
    assert (since.rows, since.since_known, since.map_version) == ((), True, version)


def test_sizes_that_the_catalogue_knows_are_taken(paged: Paged, monkeypatch: pytest.MonkeyPatch) -> None:
    """By loads, and by what is fetched ahead."""
    cache = paged.daemon.memory.cache
    guessed = cache.estimate(0, "points")
    monkeypatch.setattr(PagedView, "ready", lambda view, index, _: Ready(20_000, view.version(index)))
    assert (guessed, cache.estimate(0, "points"), cache.estimate(0, "ndt(leaf=2.0)")) == (12288, 20480, 20480)


def test_a_page_goes_when_nothing_needs_it_and_no_sooner(paged: Paged) -> None:
    paged.know(WEST, EAST)
    daemon, cache = paged.daemon, paged.daemon.memory.cache
    paged.ask(lambda n: m.Area(n, IN_THE_WEST, wait=LONG_S))
    paged.ask(lambda n: m.Selected(n, ("20_20.pcd",), wait=LONG_S))
    paged.pages.most = 1
    assert paged.paging.is_needed(WEST), "a session's area"
    assert paged.paging.is_needed(EAST), "a segment"
    paged.pages.most = 2  # only cells of pages in memory can be pinned
    assert isinstance(paged.ask(lambda n: m.Evict(n, ("20_20.pcd",))), m.Evicted)
    daemon.turn_until(lambda: not cache.ledger.retired)
    assert isinstance(paged.ask(lambda n: m.Pin(n, ("20_0.pcd",))), m.Pinned)
    paged.pages.most = 1
    assert paged.paging.is_needed(EAST), "a pin"
    paged.ask(m.Unpin)
    daemon.turn_until(lambda: not daemon.memory.scheduler.loads.by_key)
    paged.ask(lambda n: m.Evict(n, ("20_0.pcd",)))
    daemon.turn_until(lambda: not paged.pages.is_here(EAST))
    assert paged.pages.is_here(WEST)
    reply = paged.ask(lambda n: m.Area(n, EVERYWHERE))
    assert (names(reply.cells), reply.covered) == (WESTERN, False)


def test_a_waiting_request_keeps_its_pages(paged: Paged, monkeypatch: pytest.MonkeyPatch) -> None:
    paged.know(WEST, EAST)
    with monkeypatch.context() as patch:
        patch.setattr(type(paged.daemon.memory.scheduler.pool), "submit", lambda *_, **__: False)
        paged.begin(lambda n: m.Selected(n, ("20_20.pcd",), wait=LONG_S))
        paged.pages.most = 1
        assert paged.paging.is_needed(EAST)
        assert not paged.paging.is_needed(WEST)
        paged.daemon.turn_until(lambda: not paged.pages.is_here(WEST))
    assert names(paged.answer().cells) == ["20_20.pcd"]


@pytest.mark.parametrize("compared", [True, False])
def test_what_changed_since_is_known_if_it_was_known_in_both(paged: Paged, compared: bool) -> None:
    """Else the whole list is answered."""
    if compared:
        paged.know(WEST, EAST)
    before = paged.view.map_version
    paged.directory.change("20_20.pcd", 5)
    paged.read_again()
    assert paged.view.map_version != before
    paged.know(WEST, EAST)
    page = paged.ask(lambda n: m.Metadata(n, since=before))
    assert page.since_known is compared
    assert (names(page.rows) == ["20_20.pcd"]) is compared


def test_another_version_is_served_when_it_knows_what_is_known_of_this_one(paged: Paged) -> None:
    """Until then this one is, whole; a link that is lost meanwhile changes nothing."""
    paged.know(WEST, EAST)
    before = {cell.id: cell.version for cell in paged.ask(lambda n: m.Area(n, EVERYWHERE, wait=LONG_S)).cells}
    served = paged.view
    paged.directory.change("20_20.pcd", 5)
    paged.next_version()
    paged.origin.sharing = {WEST}
    paged.requests += 1
    paged.daemon.send(m.Reload(paged.requests))
    paged.daemon.turn_until(lambda: paged.origin.last is not None and paged.origin.last.pages.wanted)
    coming = paged.origin.last
    assert coming is not None
    assert (paged.view is served, coming.pages.wanted) == (True, {EAST: 0.0})
    coming.pages.fail(EAST)
    paged.daemon.turn_until(lambda: coming.pages.is_out_of_reach(EAST))
    assert (paged.view is served, paged.daemon.answered()) == (True, False)
    coming.pages.come(EAST)
    reloaded = paged.answer()
    assert (type(reloaded), reloaded.changed, paged.view is coming) == (m.Reloaded, 1, True)
    reply = paged.ask(lambda n: m.Area(n, EVERYWHERE, wait=LONG_S))
    assert [cell.id for cell in reply.cells if cell.version != before[cell.id]] == ["20_20.pcd"]
    since = paged.ask(lambda n: m.Metadata(n, since=served.map_version))
    assert (names(since.rows), since.since_known) == (["20_20.pcd"], True)


def test_a_version_that_is_held_back_is_replaced_by_a_later_one(paged: Paged) -> None:
    paged.know(WEST, EAST)
    paged.origin.sharing = {WEST}
    held: list[PagedView] = []

    def another() -> bool:
        last = paged.origin.last
        return last is not None and last not in held and bool(last.pages.wanted)

    for _ in range(2):
        paged.requests += 1
        paged.daemon.send(m.Reload(paged.requests))
        paged.daemon.turn_until(another)
        assert paged.origin.last is not None
        held.append(paged.origin.last)
    held[0].pages.come(EAST)
    held[1].pages.come(EAST)
    assert [type(paged.answer()), type(paged.answer())] == [m.Reloaded] * 2
    assert paged.view is held[1]


def test_what_changed_in_a_page_that_has_gone_comes_with_it(paged: Paged) -> None:
    paged.know(WEST, EAST)
    before = paged.view.map_version
    paged.directory.change("20_20.pcd", 5)
    paged.read_again()
    for _ in range(2):
        page = paged.ask(lambda n: m.Metadata(n, since=before))
        assert (names(page.rows), page.since_known, page.next) == (["20_20.pcd"], True, None)
        paged.know(WEST)
        page = paged.ask(lambda n: m.Metadata(n, since=before))
        assert (page.rows, page.since_known, page.next) == ((), True, 0), "nothing yet: ask again"
        paged.know(WEST, EAST)


def test_a_first_page_without_rows_says_that_the_whole_list_follows(paged: Paged) -> None:
    paged.know(EAST)
    page = paged.ask(lambda n: m.Metadata(n, since=12345))
    assert (page.rows, page.since_known, page.next) == ((), False, 0)


# --- the list of cells -----------------------------------------------------------------------------


def test_the_list_goes_page_by_page_and_waits_for_each(paged: Paged) -> None:
    first = paged.ask(m.Metadata)
    assert (sorted(names(first.rows)), first.next) == (WESTERN, EAST << 32)
    started = paged.ask(lambda n: m.Metadata(n, start=first.next))
    assert (started.rows, started.next) == ((), EAST << 32), "nothing yet: ask again"
    assert paged.pages.wanted == {EAST: 0.0}
    paged.requests += 1
    paged.daemon.send(m.Metadata(paged.requests, start=first.next))
    paged.daemon.turn_until(lambda: paged.paging.queries._waiting)
    paged.pages.come(EAST)
    second = paged.answer()
    assert (sorted(names(second.rows)), second.next) == (EASTERN, None)
    assert second.map_version == first.map_version


def test_rows_of_a_page_come_some_at_a_time(paged: Paged) -> None:
    paged.know(WEST, EAST)
    found: list[str] = []
    start: int | None = 0
    while start is not None:
        page = paged.ask(lambda n, start=start: m.Metadata(n, start=start, limit=3))  # type: ignore[misc]
        assert len(page.rows) <= 3
        found, start = found + names(page.rows), page.next
    assert (sorted(found), len(found)) == (ALL, 16)


def test_the_list_of_an_area_asks_for_no_other_page(paged: Paged) -> None:
    inside = m.BoxMessage(-35.0, -35.0, -25.0, 35.0)
    page = paged.ask(lambda n: m.Metadata(n, inside))
    assert (sorted(names(page.rows)), page.next) == (columns(-40), None)
    assert paged.pages.wanted == {}


def test_a_list_that_cannot_be_had_is_an_error(paged: Paged, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(map_queries, "METADATA_WAIT_S", LONG_S)
    paged.requests += 1
    paged.daemon.send(m.Metadata(paged.requests, start=EAST << 32))
    paged.daemon.turn_until(lambda: paged.pages.wanted)
    paged.pages.fail(EAST)
    reply = paged.answer()
    assert isinstance(reply, m.ErrorReply)
    assert reply.code == "offline"


# --- layers that look around -----------------------------------------------------------------------


def test_a_layer_that_looks_around_waits_for_the_pages_of_what_it_looks_into(paged: Paged) -> None:
    open3d_or_skip()
    beside = m.BoxMessage(-15.0, -35.0, -5.0, -25.0)  # one cell, on the border of the unknown page
    reply = paged.ask(lambda n: m.Area(n, m.BoxMessage(-35.0, -35.0, -25.0, -25.0), (HALO,), wait=LONG_S))
    assert (names(reply.cells), reply.covered) == (["-40_-40.pcd"], True)
    reply = paged.ask(lambda n: m.Area(n, beside, (HALO,), wait=0.3))
    assert (names(reply.cells), reply.covered) == ([], True), "it is known which cells touch the area"
    assert [(cell.id, cell.layer) for cell in reply.pending] == [("-20_-40.pcd", HALO)]
    assert paged.pages.wanted.keys() == {EAST}
    assert paged.daemon.memory.scheduler._for_pages, "no loader has it"
    assert not any(worker.queue for worker in paged.daemon.memory.scheduler.pool)
    paged.begin(lambda n: m.Area(n, beside, (HALO,), wait=LONG_S))
    paged.pages.come(EAST)
    (cell,) = paged.answer().cells
    index = paged.origin.whole.find("-20_-40.pcd")
    assert index is not None
    assert cell.version == LayerVersions(lambda: paged.origin.whole).version(index, HALO)


def test_a_layer_that_looks_into_what_is_out_of_reach_is_offline(paged: Paged) -> None:
    open3d_or_skip()
    paged.pages.fail(EAST)
    paged.daemon.turn_until(lambda: paged.pages.is_out_of_reach(EAST))
    reply = paged.ask(lambda n: m.Selected(n, ("-20_-40.pcd",), (HALO,), wait=LONG_S))
    assert [(one.code, one.box) for one in reply.failed] == [("offline", (-20.0, -40.0, 0.0, -20.0))]
    paged.pages.come(EAST)
    paged.daemon.turn_until(lambda: paged.pages.is_here(EAST))
    reply = paged.ask(lambda n: m.Selected(n, ("-20_-40.pcd",), (HALO,), wait=LONG_S))
    assert (names(reply.cells), reply.failed) == (["-20_-40.pcd"], ()), "at once, not when its time has come"


# --- a restart -------------------------------------------------------------------------------------


@pytest.mark.parametrize("change", [False, True])
def test_segments_of_unknown_cells_are_kept_unjudged(
    paged: Paged, whole: Callable[..., WholeDaemon], change: bool
) -> None:
    """They are judged when their page comes."""
    paged.know(WEST, EAST)
    before = {cell.id: cell for cell in paged.ask(lambda n: m.Area(n, EVERYWHERE, wait=LONG_S)).cells}
    paged.daemon.close(keep=True)
    if change:
        paged.directory.change("20_20.pcd", 5)
        paged.next_version()
    paged.origin.known = {WEST}
    paged.daemon = whole(paged.directory.root, origin=paged.origin)
    ledger, loaded = paged.daemon.memory.cache.ledger, paged.count("loads_finished")
    assert (paged.count("adopted"), ledger.resident_count) == (8, 8)
    assert ledger.set_aside_bytes == sum(before[name].bytes for name in before if Path(name).name in EASTERN)
    assert EAST in paged.pages.wanted
    reply = paged.ask(lambda n: m.Area(n, EVERYWHERE, wait=0.3))
    assert not reply.covered
    paged.know(WEST, EAST)
    assert paged.count("adopted") == 16 - change
    assert ledger.set_aside_bytes == 0
    reply = paged.ask(lambda n: m.Area(n, EVERYWHERE, wait=LONG_S))
    assert names(reply.cells) == ALL
    others = [Path(cell.id).name for cell in reply.cells if cell.segment != before[cell.id].segment]
    assert others == ["20_20.pcd"] * change
    assert paged.count("loads_finished") - loaded == int(change)


def test_unjudged_segments_are_judged_by_a_later_version_that_knows_more(
    paged: Paged, whole: Callable[..., WholeDaemon], monkeypatch: pytest.MonkeyPatch
) -> None:
    paged.know(WEST, EAST)
    paged.ask(lambda n: m.Area(n, EVERYWHERE, wait=LONG_S))
    paged.daemon.close(keep=True)
    paged.origin.known = {WEST}
    paged.daemon = whole(paged.directory.root, origin=paged.origin)
    assert paged.count("adopted") == 8
    monkeypatch.setattr(
        paged.origin, "load", lambda **_words: PagedView(paged.origin.whole, PAGES, {WEST, EAST})
    )
    paged.read_again()
    assert (paged.count("adopted"), paged.daemon.memory.cache.ledger.set_aside_bytes) == (16, 0)


def test_unjudged_segments_go_with_the_daemon(paged: Paged, whole: Callable[..., WholeDaemon]) -> None:
    paged.know(WEST, EAST)
    paged.ask(lambda n: m.Area(n, EVERYWHERE, wait=LONG_S))
    paged.daemon.close(keep=True)
    paged.origin.known = set()
    paged.daemon = whole(paged.directory.root, origin=paged.origin)
    directory = Path(paged.daemon.memory.directory.path)
    assert paged.count("adopted") == 0
    assert len(list(directory.iterdir())) == 16 + 1
    paged.daemon.close()
    assert list(directory.iterdir()) == []


# --- fetching ahead --------------------------------------------------------------------------------


def test_pages_along_the_path_are_fetched(paged: Paged) -> None:
    intent = m.Intent(-30.0, 0.0, vx=10.0, route=((-30.0, 0.0), (35.0, 0.0)))
    around = m.CircleMessage(-30.0, 0.0, 5.0)
    paged.ask(lambda n: m.Area(n, around, wait=LONG_S, intent=intent))
    paged.daemon.turn_until(lambda: EAST in paged.pages.wanted)
    assert PREFETCH < paged.pages.wanted[EAST] < PREFETCH + 60.0
    paged.know(WEST, EAST)
    cache = paged.daemon.memory.cache
    ahead = cache.catalogue.find("20_0.pcd")
    assert ahead is not None
    paged.daemon.turn_until(lambda: cache.warm.get(ahead, "points"))


def test_what_nothing_needs_is_fetched_when_no_request_waits(
    paged: Paged, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor before a client that has just come asks for something: that comes first."""
    begun, now_s = list[object](), time.monotonic()
    monkeypatch.setattr(paged.pages, "want_nearest", begun.append)
    paged.paging.run_step(now_s + 10.0)
    assert begun == []
    paged.begin(lambda n: m.Area(n, EVERYWHERE, wait=LONG_S))
    paged.paging.run_step(now_s + 20.0)
    assert begun == []
    paged.pages.come(EAST)
    assert len(paged.answer().cells) == len(ALL)
    paged.paging.run_step(now_s + 30.0)
    assert begun == [(0.0, 0.0)]


# --- clients ---------------------------------------------------------------------------------------


def test_the_client_library_says_so(paged: Paged) -> None:
    with paged.daemon.turning(), connect(paged.daemon.endpoint) as client:
        layers = ["voxel( 1 )", "points", "voxel(leaf=1.0)"]
        found = client.area(Box(-35.0, -35.0, 35.0, 35.0), layers, wait=2.0, strict=None)
        assert (found.covered, found.complete, found.reason) == (False, False, "")
        assert found.layers == ("voxel(leaf=1.0)", "points", "voxel(leaf=1.0)")
        paged.pages.fail(EAST)
        found = client.area(Box(-35.0, -35.0, 35.0, 35.0), wait=60.0, strict=None)
        assert (len(found), found.failed, found.pending) == (8, (), ())
        assert (found.covered, found.reason) == (False, "offline")
        assert "offline" in repr(found)
        found = client.area(Box(-35.0, -35.0, -5.0, 35.0), wait=60.0)
        assert (found.covered, found.complete, found.layers) == (True, True, ("points",))
        with pytest.raises(Offline):
            client.metadata()
        assert client.stats().counters["map_cells_known"] == 8
        paged.pages.come(EAST)
        while client.stats().counters["map_cells_known"] < 16:
            pass
        assert len(client.metadata()) == 16


@pytest.mark.slow
def test_so_does_the_one_in_cpp(paged: Paged, cpp_program: Path) -> None:
    with paged.daemon.turning(), CppClient(cpp_program, paged.daemon.endpoint) as client:
        everywhere = Box(-35.0, -35.0, 35.0, 35.0)
        found = client.area(everywhere, wait=0.5)
        assert (found.covered, found.complete, found.reason) == (False, False, "")
        paged.pages.fail(EAST)
        found = client.area(everywhere, wait=60.0)
        assert (len(found), found.covered, found.reason) == (8, False, "offline")
        paged.pages.come(EAST)
        while not found.covered:
            found = client.area(everywhere, wait=60.0)
        assert (len(found), found.complete, found.reason) == (16, True, "")


@pytest.mark.parametrize("background", [True, False])
def test_a_window_keeps_what_may_be_in_the_unknown_part(
    paged: Paged, whole: Callable[..., WholeDaemon], background: bool
) -> None:
    """As after a restart of the daemon."""
    options: dict[str, Any] = {"shape": "square", "update_distance": 0.5, "background": background}
    with paged.daemon.turning():
        window = MapWindow(paged.daemon.endpoint, 38.0, **options)
        paged.pages.come(EAST)
        window.move_to(0.0, 0.0, wait=LONG_S)
        assert window.wait_until_current(LONG_S)
        assert (names(window.cells), window.complete) == (ALL, True)
        assert window.covers(0.0, 0.0, 30.0)
    paged.daemon.close(keep=True)
    paged.daemon = whole(paged.directory.root, origin=paged.origin)
    with paged.daemon.turning(), window:
        update = window.move_to(1.0, 0.0, wait=0.5)
        end_s = time.monotonic() + LONG_S
        while window.error is not None or not update.current:
            assert time.monotonic() < end_s
            update = window.move_to(1.0, 0.0, wait=1.0)
        assert (update.removed, update.covered, update.complete) == ((), False, False)
        assert (names(window.cells), window.complete) == (ALL, False)
        assert not window.covers(1.0, 0.0, 1.0), "where the unknown cells lie is unknown"
        assert not window.points_around(1.0, 0.0, 1.0).covered
        assert not window.wait_until_current(0.05)
        paged.pages.come(EAST)
        update = window.move_to(1.0, 0.0, wait=LONG_S)
        assert window.wait_until_current(LONG_S)
        assert (names(window.cells), window.complete) == (ALL, True)
        assert not update.removed


def test_a_reload_that_takes_long_is_offline_and_goes_on(
    paged: Paged, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(operator_requests, "RELOAD_S", 0.05)
    go_on, load = threading.Event(), paged.origin.load

    def slow(**options: Any) -> Any:
        assert go_on.wait(LONG_S)
        return load(**options)

    monkeypatch.setattr(paged.origin, "load", slow)
    before, reloads = paged.view, paged.count("reloads")
    reply = paged.ask(m.Reload)
    assert isinstance(reply, m.ErrorReply)
    assert (reply.code, paged.view is before) == ("offline", True)
    go_on.set()
    paged.daemon.turn_until(lambda: paged.count("reloads") > reloads)
    assert paged.view is not before


def test_an_origin_out_of_reach_does_not_change_the_map(paged: Paged) -> None:
    paged.origin.offline = True
    with paged.daemon.turning(), connect(paged.daemon.endpoint) as client:
        with pytest.raises(Offline, match="does not answer") as refused:
            client.reload()
        assert refused.value.exit_code == 75
        assert len(client.area(AutowareSquare(-30.0, 0.0, 20.0), wait=LONG_S)) == len(WESTERN)

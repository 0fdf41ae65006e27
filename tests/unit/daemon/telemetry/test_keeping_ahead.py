# SPDX-License-Identifier: Apache-2.0
"""What the gauges say of clients that move: what they need, and for how long all of it is in memory."""

from __future__ import annotations

from typing import Any

import pytest

from shmmap.daemon.loading.prefetch.origin_health import IN_A_ROW
from shmmap.daemon.loading.prefetch.prefetcher import MOST_WAYS
from shmmap.daemon.loading.prefetch.way_ahead import WayAhead
from shmmap.daemon.records import Failure, Key
from shmmap.daemon.telemetry import keeping_ahead
from shmmap.daemon.telemetry.keeping_ahead import LOOKS_A_BEAT, KeepingAhead
from shmmap.daemon.transport.sessions import Session
from shmmap.geometry import Circle
from shmmap.protocol.events import Loaded, decode_event
from shmmap.protocol.messages import Area, CircleMessage, Intent, Selected
from tests.support.divided_map import DividedMap
from tests.support.moving import says
from tests.unit.daemon.inner_daemon import Inner, InnerDaemon

NOW_S = 1000.0
POINTS = ("points",)
EAST = ((-40.0, 0.0), (40.0, 0.0))
"""Through the middle of the map: with 6 m around it, and 3 m because nobody drives in the very middle of the
way, two more cells come into reach each 20 m."""


def at(
    one: InnerDaemon, x: float, y: float, *, speed: float = 5.0, layers: tuple[str, ...] = POINTS
) -> Session:
    """Return a client there that drives east and asks for 6 m around."""
    session = one.session()
    session.area, session.layers = Circle(x, y, 6.0), layers
    says(session, Intent(x, y, speed, 0.0, None, EAST if y == 0.0 else ()), NOW_S)
    one.sessions.follow_moves()
    return session


def gauges(one: InnerDaemon) -> dict[str, int]:
    """Look until a round is over; return what is told."""
    keeping = KeepingAhead(one.cache, one.scheduler, one.sessions)
    for _ in range(200):
        keeping.look(NOW_S)
        if keeping._round is None:
            return one.statistics.values
    raise AssertionError("a round never ends")


def finish(keeping: KeepingAhead) -> None:
    """Look until the round is over."""
    while keeping._round is not None:
        keeping.look(NOW_S)


def evict(one: InnerDaemon, *names: str) -> None:
    """Have cells leave memory."""
    for resident in list(one.ledger.residents()):
        if resident.key.cell_id.endswith(tuple(f"/{name}" for name in names)):
            one.reclaimer.retire(resident, NOW_S, "request")
    one.reclaimer.sweep(NOW_S)


@pytest.fixture
def one(inner: Inner, small_map: DividedMap) -> InnerDaemon:
    """Return a daemon that has all of the map in memory, and looks ten seconds ahead."""
    made: InnerDaemon = inner(small_map.root, ride_out_s=2.4, workers=3)
    made.everything()
    made.scheduler.prefetcher.ended.clear()
    health = made.scheduler.prefetcher.prefetch.health
    health.slow_s, health.mean_s = 0.0, 0.25  # not how fast this machine is
    return made


def test_nobody_moves(one: InnerDaemon) -> None:
    one.session()
    at(one, 0.0, 5.0, speed=0.0)
    told = gauges(one)
    names = ("moving_clients", "routed_clients", "fastest_mm_per_s", "needed_per_1000s", "ahead_ns")
    assert [told[name] for name in names] == [0, 0, 0, 0, 0]
    assert (told["ride_out_ns"], told["look_ahead_ns"]) == (2_400_000_000, 0)
    assert (told["most_workers"], told["loadable_per_1000s"]) == (3, 8000)


def test_what_one_client_needs(one: InnerDaemon) -> None:
    """In ten seconds it drives 50 m, and six cells come into reach."""
    at(one, -30.0, 0.0)
    told = gauges(one)
    names = ("moving_clients", "routed_clients", "fastest_mm_per_s", "needed_per_1000s")
    assert [told[name] for name in names] == [1, 1, 5000, 600]
    assert told["ahead_ns"] == told["look_ahead_ns"] == 10_000_000_000, "all of it is there"


def test_of_very_many_layers_cells_may_count_twice(one: InnerDaemon, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keeping_ahead, "MOST_TABLES", 1)
    at(one, -30.0, 0.0, layers=("points", "voxel(leaf=1.0)"))
    alone = gauges(one)["needed_per_1000s"]
    at(one, -30.0, 0.0, layers=("points", "voxel(leaf=1.0)"))
    assert gauges(one)["needed_per_1000s"] == pytest.approx(1.5 * alone, abs=1)


def test_what_several_need_counts_once(one: InnerDaemon) -> None:
    for _ in range(3):
        at(one, -30.0, 0.0)
    at(one, -30.0, 0.0, speed=3.0, layers=("points", "voxel(leaf=2.0)"))
    told = gauges(one)
    assert (told["moving_clients"], told["fastest_mm_per_s"]) == (4, 5000)
    # the last one comes 30 m far: 4 cells, of which it alone needs the other layer
    assert told["needed_per_1000s"] == 600 + 400


@pytest.mark.parametrize(("gone", "ahead_s"), [("0_0.pcd", 4.0), ("20_-20.pcd", 8.0), ("-20_0.pcd", 0.0)])
def test_for_how_long_all_is_in_memory(one: InnerDaemon, gone: str, ahead_s: float) -> None:
    at(one, -30.0, 0.0)
    evict(one, gone, "20_0.pcd", "0_20.pcd")  # the first of them counts, and the last is on nobody's way
    assert gauges(one)["ahead_ns"] == int(ahead_s * 1e9)


def test_a_cell_that_is_missed_already(one: InnerDaemon) -> None:
    at(one, -30.0, 0.0)
    evict(one, "-40_0.pcd")
    assert gauges(one)["ahead_ns"] == 0


def test_the_least_of_all_clients_counts(one: InnerDaemon) -> None:
    at(one, -30.0, 0.0)
    at(one, -10.0, 0.0)
    evict(one, "20_0.pcd")
    assert gauges(one)["ahead_ns"] == 4_000_000_000


@pytest.mark.parametrize(
    ("code", "is_out", "ahead_s"),
    [
        ("load_failed", False, 10.0),  # of that file alone: nobody will ever have it
        ("load_failed", True, 4.0),
        ("offline", False, 4.0),
        ("over_budget", False, 4.0),
        ("load_timeout", False, 4.0),
    ],
)
def test_cells_that_cannot_be_had(one: InnerDaemon, code: str, is_out: bool, ahead_s: float) -> None:
    at(one, -30.0, 0.0)
    evict(one, "0_0.pcd")
    (index,) = [i for i in range(len(one.cache.catalogue)) if one.cache.catalogue.id(i).endswith("/0_0.pcd")]
    one.loads.failures[Key(one.cache.catalogue.id(index), "points")] = Failure(code, "", None, 0.0, 0.0)
    one.scheduler.prefetcher.prefetch.health.failed_in_a_row = IN_A_ROW * is_out
    told = gauges(one)
    assert (told["ahead_ns"], told["origin_out"]) == (int(ahead_s * 1e9), is_out)


def test_times_without_the_origin(one: InnerDaemon) -> None:
    health = one.scheduler.prefetcher.prefetch.health
    keeping = KeepingAhead(one.cache, one.scheduler, one.sessions)
    told = one.statistics.values

    def look(now_s: float) -> tuple[int, int, int]:
        keeping.look(now_s)
        return told["origin_out"], told["origin_outages"], told["last_outage_ns"]

    assert look(100.0) == (0, 0, 0)
    health.failed_in_a_row = IN_A_ROW
    assert look(101.0) == (1, 1, 0)
    assert look(105.0) == (1, 1, 4_000_000_000)
    health.ended(0.1, failed=False)
    assert look(106.0) == (0, 1, 5_000_000_000)
    assert look(200.0) == (0, 1, 5_000_000_000)
    for _ in range(IN_A_ROW):
        health.ended(3.0, failed=True)
    assert look(300.0) == (1, 2, 3_000_000_000), "it was away when what has failed was begun"


def test_a_beat_looks_at_a_few_steps_only(one: InnerDaemon, monkeypatch: pytest.MonkeyPatch) -> None:
    for _ in range(300):
        at(one, -30.0, 0.0)
    looks, look = list[int](), WayAhead.look

    def counted(*arguments: Any) -> None:
        looks.append(1)
        look(*arguments)

    monkeypatch.setattr(WayAhead, "look", counted)
    keeping = KeepingAhead(one.cache, one.scheduler, one.sessions)
    monkeypatch.setattr(keeping_ahead, "LOOKS_S", -1.0)
    keeping.look(NOW_S)
    assert len(looks) == 1, "it has taken its time"
    monkeypatch.setattr(keeping_ahead, "LOOKS_S", 60.0)
    keeping.look(NOW_S)
    assert len(looks) == 1 + LOOKS_A_BEAT
    while keeping._round is not None:
        keeping.look(NOW_S)
    assert one.statistics.values["moving_clients"] == MOST_WAYS - 1, "one stands"
    assert one.statistics.values["needed_per_1000s"] == 600


def test_another_state_of_the_map_begins_anew(one: InnerDaemon, small_map: DividedMap) -> None:
    """Indices mean other cells then."""
    at(one, -30.0, 0.0)
    keeping = KeepingAhead(one.cache, one.scheduler, one.sessions)
    keeping.look(NOW_S)
    assert keeping._round is not None
    for name in ("-40_-40.pcd", "-40_-20.pcd", "-40_0.pcd", "-40_20.pcd"):
        small_map.remove_cell(name)
    small_map.write_metadata()
    one.reload()
    while one.cache.unentered:
        one.turn()
    finish(keeping)
    assert one.statistics.values["needed_per_1000s"] == 600
    assert one.statistics.values["ahead_ns"] == 10_000_000_000


def test_why_nothing_is_fetched_ahead(inner: Inner, small_map: DividedMap) -> None:
    one: InnerDaemon = inner(small_map.root, prefetch_share=0.5)
    prefetcher, ledger = one.scheduler.prefetcher, one.ledger
    assert gauges(one)["prefetch_budget_bytes"] == 32 << 20
    assert one.statistics.values["prefetch_short"] == 0
    ledger.prefetched_bytes = 32 << 20
    assert gauges(one)["prefetch_short"] == 1
    ledger.prefetched_bytes = 0
    prefetcher._full_until_s = NOW_S + 1.0
    assert gauges(one)["prefetch_short"] == 2
    off: InnerDaemon = inner(small_map.root, name="off")
    assert gauges(off)["prefetch_budget_bytes"] == 0
    assert off.statistics.values["prefetch_short"] == 0


def ahead(one: InnerDaemon) -> dict[str, bool]:
    """Return of each cell that the statistics show whether it was fetched ahead."""
    rows = {**one.statistics._missing, **one.statistics._changed}
    return {row.id: row.ahead for row in rows.values()}


def test_cells_fetched_ahead_are_told_and_shown_until_somebody_asks(
    inner: Inner, small_map: DividedMap
) -> None:
    one: InnerDaemon = inner(small_map.root, prefetch_share=0.5, ride_out_s=2.4, workers=2)
    session = one.session()
    says(session, Intent(-30.0, 0.0, 5.0, 0.0, None, EAST), one.now_s())
    circle = CircleMessage(-30.0, 0.0, 6.0)
    one.ask(session, Area(1, circle, wait=30.0))
    assert len(one.cells_of(1).cells) == 2
    one.run_until(lambda: one.statistics.values["loads_finished"] >= 8)
    pages = [decode_event(raw) for _, raw in one.event_log._kept]
    loaded = {event.id: event.ahead for event in pages if isinstance(event, Loaded)}
    asked_for = {"-40_-20.pcd", "-40_0.pcd"}
    wished = {"-20_-20.pcd", "-20_0.pcd", "0_-20.pcd", "0_0.pcd", "20_-20.pcd", "20_0.pcd"}
    assert loaded == dict.fromkeys(asked_for, False) | dict.fromkeys(wished, True)
    assert ahead(one) == loaded
    one.ask(one.session(), Selected(2, ("0_0.pcd",), wait=30.0))
    assert len(one.cells_of(2).cells) == 1
    for resident in one.cache.used:
        one.cache.rows.show(resident, "resident")
    assert ahead(one) == loaded | {"0_0.pcd": False}
    told = one.statistics.values
    assert (told["prefetch_started"], told["prefetch_used"], told["cells_late"]) == (6, 1, 0)
    assert told["bytes_loaded"] == 8 * told["bytes_used"] // 3, "of eight of one size three are used"
    evict(one, "20_0.pcd")
    assert told["prefetch_in_vain"] == 1

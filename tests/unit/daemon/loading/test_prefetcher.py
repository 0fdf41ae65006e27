# SPDX-License-Identifier: Apache-2.0
"""Cells are loaded before a client asks for them: with real loaders, and memory that is really short."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from shmmap.daemon.cache.eviction_plan import HAND_OUT_GRACE_S
from shmmap.daemon.loading.loads import PREFETCH, Attempt, Load, Purpose
from shmmap.daemon.loading.look_ahead import IN_A_ROW, URGENT_S
from shmmap.daemon.loading.prefetcher import FULL_S, KEPT, MAX_PATHS
from shmmap.daemon.records import Key
from shmmap.daemon.transport.sessions import Session
from shmmap.protocol.events import Loaded, Recent, decode_event
from shmmap.protocol.messages import Area, CircleMessage, Intent, Selected
from tests.support.connections import says
from tests.support.divided_map import DividedMap, make_map
from tests.unit.daemon.inner_daemon import Inner, InnerDaemon, names

RADIUS_M = 30.0
SPEED_MPS = 10.0


@pytest.fixture
def street(tmp_path: Path) -> DividedMap:
    """Return a map of 40 x 3 cells of 20 m, from x = -400 m to 400 m."""
    return make_map(tmp_path / "street", columns=40, rows=3, points=60)


class Drive:
    """A client that drives along the street, with 10 m/s."""

    def __init__(self, one: InnerDaemon, x: float = -350.0, *, layers: tuple[str, ...] = ("points",)) -> None:
        self.one, self.layers = one, layers
        self.session: Session = one.session()
        self.request = 0
        self.ask(x)

    def ask(self, x: float, wait: float = 30.0) -> list[str]:
        """Say where it is, and ask for what is around; returns the cells."""
        self.request += 1
        session = self.session
        says(session, Intent(x, 10.0, vx=SPEED_MPS, route=((x, 10.0), (400.0, 10.0))), self.one.now_s())
        area = CircleMessage(x, 10.0, RADIUS_M)
        return names(self.one.cells_for(Area(self.request, area, self.layers, wait=wait), session))


def count(one: InnerDaemon, name: str) -> int:
    return int(one.statistics.values[name])


def idle(one: InnerDaemon) -> bool:
    """Whether nothing is loading, and nothing wished for until later."""
    prefetcher = one.scheduler.prefetcher
    return not one.loads.by_key and not prefetcher.ended and prefetcher.next_s > one.now_s()


@pytest.fixture
def prefetching(inner: Inner, street: DividedMap) -> Callable[..., InnerDaemon]:
    def factory(**options: object) -> InnerDaemon:
        return inner(street.root, **{"prefetch_share": 0.5, "workers": 2, **options})

    return factory


def test_a_moving_client_finds_its_cells_in_memory(prefetching: Callable[..., InnerDaemon]) -> None:
    one = prefetching()
    drive = Drive(one)
    one.run_until(lambda: idle(one))
    loaded, misses = count(one, "prefetch_started"), count(one, "misses")
    assert loaded > 3 * 4, "the street has three rows; twelve seconds are six columns"
    assert one.ledger.prefetched_bytes == sum(r.nbytes for r in one.ledger.residents() if r.prefetched) > 0
    seen = set[str]()
    for x in (-340.0, -330.0, -320.0, -310.0, -300.0):
        one.offset_s += 1.0
        seen.update(drive.ask(x, wait=0.0))
    one.turn()
    assert count(one, "misses") == misses
    assert count(one, "prefetch_misses") == 0
    assert count(one, "prefetch_used") == len([r for r in one.ledger.residents() if r.hits]) - misses > 5
    assert len(seen) > 5
    assert one.ledger.prefetched_bytes == sum(r.nbytes for r in one.ledger.residents() if r.prefetched)
    assert count(one, "bytes_used") < count(one, "bytes_loaded")


def test_loads_that_were_begun_in_an_outage_do_not_make_another_one(
    prefetching: Callable[..., InnerDaemon],
) -> None:
    """They fail seconds after others have succeeded, if the origin is silent."""
    one = prefetching()
    Drive(one)
    one.run_until(lambda: idle(one))
    prefetcher, now_s = one.scheduler.prefetcher, one.now_s()
    health = prefetcher.health
    load = Load(Key("a", "points"), 0, 0.0, 1)

    def end(after_s: float, took_s: float, out: bool) -> tuple[bool, int]:
        load.attempt = Attempt(0.0, (bytes(24),), took_s=took_s)
        prefetcher.note_end(load, out=out)
        while prefetcher.ended:
            prefetcher.run_step(now_s + after_s)
        return health.is_out, health.failed_in_a_row

    for number in range(IN_A_ROW):
        found = end(10.0 + 0.01 * number, 4.0, True)
    assert found == (True, IN_A_ROW)
    assert end(20.0, 0.5, False) == (False, 0)
    for _ in range(2 * IN_A_ROW):
        found = end(21.0, 4.0, True)
    assert found == (False, 0), "they were begun at 17 s"
    for _ in range(IN_A_ROW):
        found = end(26.0, 4.0, True)
    assert found == (True, IN_A_ROW)


def test_without_a_path_nothing_is_fetched(inner: Inner, street: DividedMap) -> None:
    """For a client that stands still or has gone, or where prefetching is switched off."""
    off = inner(street.root, prefetch_share=0.0)
    Drive(off)
    off.run_until(lambda: idle(off))
    one = inner(street.root, prefetch_share=0.5)
    session = one.session()
    one.cells_for(Area(1, CircleMessage(0.0, 10.0, RADIUS_M), wait=30.0), session)
    one.run_until(lambda: idle(one))
    assert [count(each, "prefetch_started") for each in (off, one)] == [0, 0]
    drive = Drive(one)
    one.turn()
    assert len(one.scheduler.prefetcher.prefetch.paths) == 2
    drive.session.disconnect()
    session.disconnect()
    one.run_until(lambda: idle(one))
    assert not one.scheduler.prefetcher.prefetch.paths


def test_of_a_crowd_a_limited_number_of_clients_is_followed(inner: Inner, street: DividedMap) -> None:
    one = inner(street.root, prefetch_share=0.5)
    for number in range(MAX_PATHS + 10):
        one.ask(one.session(), Area(number, CircleMessage(0.0, 10.0, 1.0), wait=0.0))
    one.run_until(lambda: not one.sessions.moved and not one.scheduler.prefetcher.cold)
    assert len(one.scheduler.prefetcher.prefetch.paths) == MAX_PATHS


@pytest.mark.parametrize("soon", [True, False])
def test_what_is_nearly_a_demand_takes_the_last_loader_too(
    prefetching: Callable[..., InnerDaemon], *, soon: bool
) -> None:
    one = prefetching()
    one.everything()
    while len(one.pool) < one.pool.limit:
        one.pool.start_one()
    with one.loaders_standing_still():
        drive = Drive(one)
        for resident in list(one.ledger.residents()):
            if resident.box[0] == -300.0 if soon else resident.box[0] > -290.0:
                one.reclaimer.retire(resident, one.now_s(), "request")
        one.reclaimer.sweep(one.now_s())
        one.run_until(lambda: len(one.loads.by_key) == (2 if soon else 1))
        for _ in range(10):
            drive.ask(-350.0, wait=0.0)
            one.turn()
        needed_in_s = [load.priority - PREFETCH for load in one.loads.by_key.values()]
        assert len(needed_in_s) == (2 if soon else 1)
        assert (max(needed_in_s) <= URGENT_S) == soon
    one.run_until(lambda: idle(one))


def test_as_many_are_fetched_as_there_are_free_places(prefetching: Callable[..., InnerDaemon]) -> None:
    """Some are kept, and a demand has one at once."""
    one = prefetching()
    one.pool.places = 8
    one.everything()
    while len(one.pool) < one.pool.limit:
        one.pool.start_one()
    with one.loaders_standing_still():
        drive = Drive(one)
        for resident in list(one.ledger.residents()):
            if resident.box[0] > -290.0:
                one.reclaimer.retire(resident, one.now_s(), "request")
                one.reclaimer.never_revive(resident.key)
        one.run_until(lambda: len(one.scheduler._jobs) == 2 * 8 - 8 // KEPT)
        for _ in range(10):
            drive.ask(-350.0, wait=0.0)
            one.turn()
        assert len(one.scheduler._jobs) == 2 * 8 - 8 // KEPT
        assert all(load.work is Purpose.WISH for load in one.scheduler._jobs.values())
        one.ask(one.session(), Selected(50, ("380_0.pcd",), wait=30.0))
        one.run_until(lambda: any(load.work is not Purpose.WISH for load in one.scheduler._jobs.values()))
    assert names(one.cells_of(50)) == ["380_0.pcd"]
    one.run_until(lambda: idle(one))


def test_what_is_asked_for_while_it_is_fetched_is_loaded_once(
    prefetching: Callable[..., InnerDaemon],
) -> None:
    one = prefetching(workers=1)
    drive = Drive(one)
    with one.loaders_standing_still():
        one.run_until(
            lambda: any(load.work is Purpose.WISH and load.is_running for load in one.loads.by_key.values())
        )
        (load,) = one.loads.by_key.values()
        other, started = one.session(), count(one, "loads_started")
        one.ask(other, Selected(50, (load.key.cell_id,), wait=30.0))
        assert load.work is not Purpose.WISH
        assert count(one, "prefetch_overtaken") == 1
    assert len(names(one.cells_of(50))) == 1
    resident = one.ledger.by_key[load.key]
    assert (resident.prefetched, resident.hits) == (False, 1)
    assert count(one, "loads_started") >= started
    one.run_until(lambda: idle(one))
    assert count(one, "loads_finished") == len(list(one.ledger.residents())), "none came twice"
    assert drive.session.motion.travelled_m == 0.0


def test_a_moving_client_that_has_to_wait_is_a_prefetch_miss(prefetching: Callable[..., InnerDaemon]) -> None:
    """Not one that has just come, nor one that jumps."""
    one = prefetching(prefetch_share=1e-9)  # a path, but no memory for it
    drive = Drive(one)
    one.run_until(lambda: not one.sessions.moved and not one.scheduler.prefetcher.cold)
    assert count(one, "prefetch_misses") == 0
    one.offset_s += 2.0
    drive.ask(-330.0)
    one.run_until(lambda: not one.sessions.moved and not one.scheduler.prefetcher.cold)
    assert count(one, "prefetch_misses") == 3
    one.offset_s += 1.0
    drive.ask(300.0)
    one.run_until(lambda: not one.sessions.moved and not one.scheduler.prefetcher.cold)
    assert count(one, "prefetch_misses") == 3
    assert count(one, "prefetch_started") == 0


def test_a_full_share_gives_up_what_is_needed_later(prefetching: Callable[..., InnerDaemon]) -> None:
    """A client turns round: what lies ahead of it now takes the place of what no client comes to any more."""
    one = prefetching()
    each = one.cache.estimate(0, "points")
    one.scheduler.prefetcher.share = (6.5 * each) / one.ledger.budget_bytes
    drive = Drive(one, 0.0)
    one.run_until(lambda: idle(one))

    def ahead() -> set[float]:
        return {resident.box[0] for resident in one.ledger.residents() if resident.prefetched}

    assert {40.0, 60.0} <= ahead() <= {40.0, 60.0, 80.0}, "what is needed first"
    for _ in range(3):
        one.offset_s += 1.0
        intent = Intent(0.0, 10.0, vx=-SPEED_MPS, route=((0.0, 10.0), (-400.0, 10.0)))
        says(drive.session, intent, one.now_s())
        one.turn()
        one.run_until(lambda: idle(one))
    assert {-60.0, -80.0} <= ahead()
    assert not {60.0, 80.0} & ahead()
    assert one.ledger.prefetched_bytes == sum(r.nbytes for r in one.ledger.residents() if r.prefetched)
    assert one.ledger.prefetched_bytes <= 6.5 * each


def test_what_is_needed_sooner_does_not_make_room(prefetching: Callable[..., InnerDaemon]) -> None:
    """What lies behind is evicted, what is nearer ahead is not; nothing is refused or failed."""
    one = prefetching(prefetch_share=1.0)
    drive = Drive(one)
    one.run_until(lambda: idle(one))
    each = max(resident.nbytes for resident in one.ledger.residents())
    few = prefetching(prefetch_share=1.0)
    estimate = few.cache.estimate(0, "points")
    few.ledger.budget_bytes = few.ledger.overhead_bytes + 16 * each + 2 * estimate
    drive = Drive(few)

    def settled() -> bool:
        return idle(few) or few.scheduler.prefetcher.next_s - few.now_s() > FULL_S / 2

    few.run_until(lambda: settled() and not few.loads.by_key)
    columns = sorted({int(r.key.cell_id.rsplit("/", 1)[1].split("_")[0]) for r in few.ledger.residents()})
    assert columns == list(range(columns[0], columns[-1] + 1, 20)), "the next ones, without a gap"
    assert few.loads.failures == {}
    assert count(few, "refused_over_budget") == 0
    before = columns[-1]
    for x in (-320.0, -290.0, -260.0):  # it releases what it has left behind
        few.offset_s += 3.0 + HAND_OUT_GRACE_S
        drive.session.drop(list(drive.session.held))
        assert drive.ask(x)
        few.run_until(lambda: settled() and not few.loads.by_key)
    columns = sorted({int(r.key.cell_id.rsplit("/", 1)[1].split("_")[0]) for r in few.ledger.residents()})
    assert columns[-1] > before, "what is behind made room for what is ahead"
    assert few.evictor.evicted_count > 0
    assert count(few, "prefetch_in_vain") < count(few, "prefetch_used")


def test_an_origin_that_comes_back_is_used_at_once(
    prefetching: Callable[..., InnerDaemon], street: DividedMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While it is away one load now and then shows whether it is; then what had failed is tried at once."""
    monkeypatch.setenv("SHMMAP_TEST_WORKER", "offline:")
    marks = [Path(street.id(f"{x}_{y}.pcd") + ".offline") for x in range(-300, 400, 20) for y in (-20, 0, 20)]
    for mark in marks:
        mark.touch()
    one = prefetching()
    drive = Drive(one)
    health = one.scheduler.prefetcher.health
    one.run_until(lambda: health.is_out)
    tried = count(one, "prefetch_started")
    for _ in range(3):
        one.turn()
    assert count(one, "prefetch_started") == tried, "not again at once"
    for mark in marks:
        mark.unlink()
    one.stop_clock()
    one.offset_s += 0.5
    one.run_until(lambda: not health.is_out)
    assert not [key for key, failure in one.loads.failures.items() if failure.code == "offline"]
    one.stopped_at_s = None
    one.run_until(lambda: idle(one))
    assert drive.ask(-340.0, wait=0.0)
    assert len({r.key.cell_id for r in one.ledger.residents()}) > 3 * 8


def test_broken_files_are_no_matter_of_where_they_come_from(
    prefetching: Callable[..., InnerDaemon], street: DividedMap
) -> None:
    """One after the other on the path: each is tried once for now, and what lies behind them is fetched."""
    broken = [f"{x}_{y}.pcd" for x in (-300, -280) for y in (-20, 0, 20)]
    for name in broken:
        Path(street.id(name)).write_bytes(b"no points")
    one = prefetching()
    one.stop_clock()
    Drive(one)
    one.run_until(lambda: idle(one))
    assert not one.scheduler.prefetcher.health.is_out
    assert {Path(key.cell_id).name for key in one.loads.failures} == set(broken)
    assert count(one, "loads_failed") == len(broken)
    there = {Path(resident.key.cell_id).name for resident in one.ledger.residents()}
    assert {"-260_0.pcd", "-240_0.pcd"} <= there


def test_a_cell_that_can_never_fit_keeps_no_other_one_out(
    prefetching: Callable[..., InnerDaemon], street: DividedMap
) -> None:
    large = make_map(street.root.parent / "large", columns=1, rows=1, points=20_000)
    Path(street.id("-300_0.pcd")).write_bytes(next(large.pcd_dir.glob("*.pcd")).read_bytes())
    one = prefetching(prefetch_share=(100 << 10) / (64 << 20))
    Drive(one)
    one.run_until(lambda: idle(one))
    there = {Path(resident.key.cell_id).name for resident in one.ledger.residents()}
    assert "-300_0.pcd" not in there
    assert {"-300_-20.pcd", "-280_0.pcd"} <= there


def shown_ahead(one: InnerDaemon) -> dict[str, bool]:
    """Return of each cell in the daemon's list whether it was fetched ahead."""
    return {row.id: row.ahead for row in one.listed()}


def test_cells_fetched_ahead_are_events_and_shown_until_a_client_asks(
    inner: Inner, small_map: DividedMap
) -> None:
    one: InnerDaemon = inner(small_map.root, prefetch_share=0.5, outage_tolerance_s=2.4, workers=2)
    session = one.session()
    route = ((-40.0, 0.0), (40.0, 0.0))
    says(session, Intent(-30.0, 0.0, 5.0, 0.0, None, route), one.now_s())
    assert len(one.cells_for(Area(1, CircleMessage(-30.0, 0.0, 6.0), wait=30.0), session).cells) == 2
    one.run_until(lambda: count(one, "loads_finished") >= 8)
    events = map(decode_event, one.event_log.page(Recent(1)).events)
    loaded = {event.id: event.ahead for event in events if isinstance(event, Loaded)}
    asked_for = {"-40_-20.pcd", "-40_0.pcd"}
    wished = {"-20_-20.pcd", "-20_0.pcd", "0_-20.pcd", "0_0.pcd", "20_-20.pcd", "20_0.pcd"}
    assert loaded == dict.fromkeys(asked_for, False) | dict.fromkeys(wished, True)
    assert shown_ahead(one) == loaded
    assert len(one.cells_for(Selected(2, ("0_0.pcd",), wait=30.0)).cells) == 1
    assert shown_ahead(one) == loaded | {"0_0.pcd": False}
    assert [count(one, name) for name in ("prefetch_started", "prefetch_used", "prefetch_misses")] == [
        6,
        1,
        0,
    ]
    assert count(one, "bytes_loaded") == 8 * count(one, "bytes_used") // 3, (
        "of eight of one size three are used"
    )
    unused = next(r for r in one.ledger.residents() if r.key.cell_id.endswith("/20_0.pcd"))
    one.reclaimer.retire(unused, one.now_s(), "request")
    one.reclaimer.sweep(one.now_s())
    assert count(one, "prefetch_in_vain") == 1

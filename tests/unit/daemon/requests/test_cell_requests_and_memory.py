# SPDX-License-Identifier: Apache-2.0
"""Requests for cells where memory is short: evictions, full budgets, loaders that wait for room."""

from __future__ import annotations

import contextlib
import os
import signal
from itertools import pairwise
from pathlib import Path

import pytest

from shmmap.daemon.cache import holders
from shmmap.daemon.cache.eviction_plan import HAND_OUT_GRACE_S
from shmmap.daemon.cache.evictor import Freeing
from shmmap.daemon.cache.holders import Holders
from shmmap.daemon.loading.room import AHEAD_SHARE, Room
from shmmap.daemon.records import Key, Resident
from shmmap.protocol.messages import (
    Area,
    CircleMessage,
    Selected,
)
from tests.support.divided_map import DividedMap, make_map, write_ascii
from tests.unit.daemon.inner_daemon import EVERYWHERE, Inner, names


def test_evicted_while_a_request_waits_for_others(inner: Inner, small_map: DividedMap) -> None:
    """It is put back or loaded once more while there is time: never forgotten."""
    one = inner(small_map.root)
    session = one.session()
    one.cells_for(Selected(1, ("0_0.pcd", "20_20.pcd"), wait=30.0), session)
    first = one.cache.warm.layers["points"][one.cache.index_of("0_0.pcd") or 0]
    second = one.cache.warm.layers["points"][one.cache.index_of("20_20.pcd") or 0]
    wanted = ("0_0.pcd", "20_20.pcd", "0_0.pcd", "20_0.pcd")
    with one.loaders_standing_still(), open(one.path_of(second.name.rsplit(".", 1)[1]), "rb"):
        one.ask(session, Selected(2, wanted, wait=30.0))
        one.reclaimer.retire(first, one.now_s() - 1.0)
        one.reclaimer.retire(second, one.now_s() - 1.0)
        one.run_until(lambda: first.name not in one.ledger.retired)
        assert second.name in one.ledger.retired, "a process has it open"
        os.kill(next(iter(one.pool)).pid, signal.SIGCONT)
        reply = one.cells_of(2)
    assert names(reply) == list(wanted)
    assert reply.cells[0].segment != first.name.rsplit(".", 1)[1], "loaded once more"
    assert reply.cells[1].segment == second.name.rsplit(".", 1)[1], "put back in service"
    assert reply.pending == ()
    assert sum(reply.request == 2 for _, reply in one.replies) == 1, "although a cell was asked for twice"


def sizes(small_map: DividedMap, inner: Inner) -> int:
    """Bytes of one ordinary segment of this map (all are alike)."""
    one = inner(small_map.root)
    one.everything()
    return min(resident.nbytes for resident in one.ledger.residents())


def test_a_budget_that_is_just_enough(inner: Inner, small_map: DividedMap) -> None:
    """While cells load more is reserved than they come to need: no reason to refuse the last ones."""
    each = sizes(small_map, inner)
    one = inner(small_map.root, workers=2)
    estimate = one.cache.estimate(0, "points")
    assert estimate > each
    one.ledger.budget_bytes = one.ledger.overhead_bytes + 15 * each + estimate
    reply = one.everything()
    assert (len(reply.cells), reply.failed) == (16, ())
    other = inner(small_map.root, workers=2)
    other.ledger.budget_bytes = other.ledger.overhead_bytes + 15 * each + estimate - 4096
    reply = other.everything()
    assert (len(reply.cells), [failure.code for failure in reply.failed]) == (15, ["over_budget"])


def test_looking_for_room_where_others_map_everything_comes_to_an_end(
    inner: Inner, small_map: DividedMap
) -> None:
    """The daemon looks at what they map, which is no close for which it would look again."""
    one = inner(small_map.root)
    one.everything()
    with contextlib.ExitStack() as stack:
        for resident in one.ledger.residents():
            stack.enter_context(open(one.path_of(resident.name.rsplit(".", 1)[1]), "rb"))
        for _ in range(3):
            one.offset_s += 5.0
            looks = 0
            while one.evictor.free(1 << 30, one.now_s()) is not Freeing.NO_MORE:
                looks += 1
                assert looks < 10
                one.scheduler.room.on_report(lambda: one.cache.reclaimer.on_closes(one.now_s()))


def test_what_is_mapped_and_asked_for_repeatedly_is_no_reason_to_wait(
    inner: Inner, small_map: DividedMap
) -> None:
    """Another client is refused at once, though each answer begins another grace for what it hands out."""
    each = sizes(small_map, inner)
    one = inner(small_map.root)
    one.ledger.budget_bytes = one.ledger.overhead_bytes + 4 * each + 8192
    reader, other = one.session("reader"), one.session("other")
    opened = [
        os.open(one.path_of(cell.segment), os.O_RDONLY)
        for cell in one.cells_for(Area(1, CircleMessage(0, 0, 5), wait=30.0), reader).cells
    ]
    assert len(opened) == 4
    one.ask(other, Selected(2, ("20_20.pcd",), wait=3000.0))
    request = 10

    def answered() -> bool:
        nonlocal request
        request += 1
        one.ask(reader, Area(request, CircleMessage(0, 0, 5)))
        return any(reply.request == 2 for _, reply in one.replies)

    one.run_until(answered)
    (failure,) = one.cells_of(2).failed
    assert failure.code == "over_budget"
    assert [(holder.session, holder.cells) for holder in failure.holders] == [(0, 4)]
    for fd in opened:
        os.close(fd)
    one.cells.release(reader.drop(list(reader.held)))
    one.offset_s += 2.0
    assert names(one.cells_for(Selected(3, ("20_20.pcd",), wait=30.0), other)) == ["20_20.pcd"]


def test_room_is_made_for_several_loads_at_once(
    inner: Inner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For those that wait, within a part of the budget; not for each when the one before it has its room."""
    made = make_map(tmp_path / "many", columns=13, rows=8, points=50)
    one = inner(made.root)
    ids = [one.cache.catalogue.id(index) for index in range(104)]
    reader = one.session()
    assert len(one.cells_for(Selected(1, tuple(ids[:96]), wait=30.0), reader).cells) == 96
    one.cells.release(reader.drop(list(reader.held)))
    (each,) = {resident.nbytes for resident in one.ledger.residents()}
    estimate = one.cache.estimate(96, "points")
    budget = one.ledger.budget_bytes = one.ledger.used_bytes
    one.offset_s += 2.0
    one.stop_clock()  # what is evicted is not free before the clock has gone on
    one.ask(reader, Selected(2, tuple(ids[96:]), wait=30.0))
    for _ in range(50):
        one.turn(0.0)
    given_up = -(-(estimate + min(7 * estimate, budget // AHEAD_SHARE)) // each)
    assert one.ledger.unopened_bytes == given_up * each > 2 * estimate
    with monkeypatch.context() as patch:
        patch.setattr(Room, "why_not", lambda *_: pytest.fail("nothing has changed"))
        for _ in range(50):
            one.turn(0.0)
    one.stopped_at_s = None
    assert len(one.cells_of(2).cells) == 8
    assert one.ledger.used_bytes <= budget


def test_two_loads_that_need_more_than_both_can_have(inner: Inner, small_map: DividedMap) -> None:
    """One is refused, and its room given to the other: no deadlock, no deadline."""
    for name in ("0_0.pcd", "20_20.pcd"):
        write_ascii(small_map.pcd_dir / name, 50_000)
    one = inner(small_map.root, workers=2)
    half = one.cache.estimate(one.cache.index_of("0_0.pcd") or 0, "points")
    one.ledger.budget_bytes = one.ledger.overhead_bytes + 2 * half + 100_000
    reply = one.cells_for(Selected(1, ("0_0.pcd", "20_20.pcd"), wait=3000.0))
    assert len(reply.cells) == 1
    assert [failure.code for failure in reply.failed] == ["over_budget"]
    assert one.statistics.values["loads_timed_out"] == 0
    assert one.ledger.reserved_bytes == 0


@pytest.mark.parametrize("ends", ["killed", "overdue"])
def test_the_end_of_a_loader_that_waits_for_room(inner: Inner, small_map: DividedMap, ends: str) -> None:
    """It is killed, or its deadline is over: nothing stays reserved, and what fits is loaded."""
    write_ascii(small_map.pcd_dir / "20_20.pcd", 50_000)
    each = sizes(small_map, inner)
    one = inner(small_map.root)
    one.ledger.budget_bytes = one.ledger.overhead_bytes + 50_000 * 12 + 2 * 4096 + 2 * each
    session = one.session()
    one.stop_clock()  # the cells handed out first stay in their grace
    assert len(one.cells_for(Area(1, CircleMessage(0, 0, 5), wait=30.0), session).cells) == 4
    one.ask(session, Selected(2, ("20_20.pcd", "20_0.pcd"), wait=900.0))
    one.run_until(lambda: one.scheduler.room.awaiting_grant)
    (worker,) = one.pool
    if ends == "killed":
        os.kill(worker.pid, signal.SIGKILL)
        one.run_until(lambda: worker not in list(one.pool))
    one.offset_s += 301.0
    (failure,) = one.cells_of(2).failed
    assert failure.code == ("load_failed" if ends == "killed" else "load_timeout")
    assert ("SIGKILL" in failure.message) == (ends == "killed")
    one.run_until(lambda: not one.ledger.reserved_bytes)
    assert one.scheduler.room.awaiting_grant == {}
    assert worker not in list(one.pool)


def test_the_loop_sleeps_once_no_load_waits_for_the_end_of_a_grace(
    inner: Inner, small_map: DividedMap
) -> None:
    each = sizes(small_map, inner)
    one = inner(small_map.root)
    one.ledger.budget_bytes = one.ledger.overhead_bytes + 5 * each
    one.stop_clock()  # the cells handed out first stay in their grace
    assert len(one.cells_for(Area(1, CircleMessage(0, 0, 5), wait=30.0)).cells) == 4
    one.ask(one.session(), Selected(2, ("20_20.pcd",), wait=900.0))
    one.run_until(lambda: one.now_s() < one.scheduler.next_event_s() <= one.now_s() + HAND_OUT_GRACE_S)
    small_map.remove_cell("20_20.pcd")
    small_map.write_metadata()
    one.reload()
    one.turn()
    assert not len(one.loads)
    one.offset_s += HAND_OUT_GRACE_S
    one.turn()
    assert one.scheduler.next_event_s() > one.now_s()


def test_duplicates_count_once_for_the_quota(inner: Inner, small_map: DividedMap) -> None:
    quota = 3 * inner(small_map.root).cache.estimate(0, "points")
    one = inner(small_map.root, quota_bytes=quota)
    session, ids = one.session(), ("0_0.pcd",) * 10 + ("20_20.pcd",) * 10
    for request in (1, 2):  # cold, then warm
        reply = one.cells_for(Selected(request, ids, wait=30.0), session)
        assert (names(reply), reply.failed) == (list(ids), ())
    reply = one.everything(3)
    assert {failure.code for failure in reply.failed} == {"over_budget"}
    assert one.statistics.values["refused_quota"] == len(reply.failed)


def test_very_many_loads_are_refused_one_at_a_time(inner: Inner, tmp_path: Path) -> None:
    """Between loads that find no room another client may come, and the next one follows at once."""
    made = make_map(tmp_path / "many", columns=11, rows=11, points=5)
    one = inner(str(made.root), budget_bytes=1 << 20)
    one.ledger.overhead_bytes = one.ledger.budget_bytes  # nothing fits, and nothing can make room
    one.ask(one.session(), Area(1, EVERYWHERE, wait=900.0))
    left = [len(one.loads)]
    while left[-1]:
        one.scheduler.pump(one.now_s())
        left.append(len(one.loads))
        assert (one.scheduler.unfinished and one.scheduler.next_event_s() == 0.0) or not left[-1]
    assert all(before - after == 1 for before, after in pairwise(left))
    assert {failed.code for failed in one.cells_of(1).failed} == {"over_budget"}


def test_the_holders_of_memory_are_those_of_the_largest_segments(
    inner: Inner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However many segments there are; and it is said beside each cell that there is none for."""
    made = make_map(tmp_path / "many", columns=8, rows=8, points=5)
    one = inner(str(made.root))
    one.everything()
    gone = one.ledger.by_key[Key(one.cache.catalogue.id(0), "points")]
    one.reclaimer.retire(gone, one.now_s() - 1.0)
    one.run_until(lambda: gone.name not in one.ledger.retired)
    one.ledger.overhead_bytes = one.ledger.budget_bytes
    looks, look = list[Resident](), Holders.slots_of

    def counted(found: Holders, resident: Resident) -> list[int] | None:
        looks.append(resident)
        return look(found, resident)

    monkeypatch.setattr(Holders, "slots_of", counted)
    monkeypatch.setattr(holders, "MAX_HOLDING_SEGMENTS", 10)
    (failed,) = one.cells_for(Area(2, EVERYWHERE, wait=900.0)).failed
    assert (failed.code, failed.holders) == ("over_budget", ()), "nothing is mapped"
    assert 0 < len(looks) <= 10

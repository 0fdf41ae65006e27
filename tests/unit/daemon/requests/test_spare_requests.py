# SPDX-License-Identifier: Apache-2.0
"""Requests of programs that look on: they cost other clients no time, no memory and no cell."""

from __future__ import annotations

from shmmap.daemon.transport.sessions import Session
from shmmap.protocol.messages import Cells, Selected
from tests.support.divided_map import DividedMap
from tests.unit.daemon.inner_daemon import Inner, InnerDaemon, names

FOUR = ("0_0.pcd", "20_0.pcd", "0_20.pcd", "20_20.pcd")


def looks(one: InnerDaemon, session: Session, *ids: str, request: int = 50, wait: float = 30.0) -> Cells:
    return one.cells_for(Selected(request, ids, wait=wait, spare=True), session)


def resident(one: InnerDaemon) -> set[str]:
    return {segment.key.cell_id.rsplit("/", 1)[1] for segment in one.ledger.residents()}


def test_one_load_at_a_time(inner: Inner, small_map: DividedMap) -> None:
    one = inner(small_map.root, workers=2)
    viewer = one.session("viewer")
    for count in range(1, 5):
        reply = looks(one, viewer, *FOUR, request=count)
        assert (len(reply.cells), len(reply.pending), reply.failed) == (count, 4 - count, ())
    assert all(segment.spare for segment in one.ledger.residents())
    assert not one.loads.by_key, "what is pending is not promised"


def test_nothing_while_others_wait_for_loads(inner: Inner, small_map: DividedMap) -> None:
    one = inner(small_map.root)
    other, viewer = one.session("other"), one.session("viewer")
    looks(one, viewer, FOUR[0])
    with one.loaders_standing_still():
        one.ask(other, Selected(1, FOUR[1:3], wait=30.0))
        reply = looks(one, viewer, *FOUR)
        assert names(reply) == [FOUR[0]]
        assert {load.key.cell_id.rsplit("/", 1)[1] for load in one.loads.by_key.values()} == set(FOUR[1:3])
    assert len(one.cells_of(1).cells) == 2


def test_it_waits_for_what_others_load(inner: Inner, small_map: DividedMap) -> None:
    one = inner(small_map.root)
    other, viewer = one.session("other"), one.session("viewer")
    one.ask(other, Selected(1, FOUR[:1], wait=30.0))
    assert names(looks(one, viewer, FOUR[0])) == [FOUR[0]]
    assert not any(segment.spare for segment in one.ledger.residents()), "it was loaded for another"


def test_full_memory_stays_as_it_is(inner: Inner, small_map: DividedMap) -> None:
    one = inner(small_map.root)
    other, viewer = one.session("other"), one.session("viewer")
    one.cells_for(Selected(1, FOUR[:2], wait=30.0), other)
    one.cells.release(other.drop(list(other.held)))
    one.offset_s += 2.0
    one.ledger.budget_bytes = one.ledger.used_bytes + 4096
    before = resident(one)
    reply = looks(one, viewer, FOUR[2])
    assert (len(reply.cells), len(reply.pending), reply.failed) == (0, 1, ())
    assert resident(one) == before
    assert not one.loads.failures
    assert names(one.cells_for(Selected(2, FOUR[2:3], wait=30.0), other)) == [FOUR[2]], "others get room"


def test_what_was_loaded_for_it_goes_first(inner: Inner, small_map: DividedMap) -> None:
    one = inner(small_map.root)
    other, viewer = one.session("other"), one.session("viewer")
    one.cells_for(Selected(1, FOUR[:2], wait=30.0), other)
    one.cells.release(other.drop(list(other.held)))
    one.offset_s += 2.0
    looks(one, viewer, FOUR[2])
    looks(one, viewer, FOUR[0], request=51)
    one.cells.release(viewer.drop(list(viewer.held)))
    (spare,) = (segment for segment in one.ledger.residents() if segment.spare)
    one.ledger.budget_bytes = one.ledger.used_bytes - spare.nbytes + one.cache.estimate(0, "points")
    assert names(one.cells_for(Selected(2, FOUR[3:], wait=30.0), other)) == [FOUR[3]]
    assert resident(one) == {FOUR[0], FOUR[1], FOUR[3]}


def test_another_request_keeps_it(inner: Inner, small_map: DividedMap) -> None:
    one = inner(small_map.root)
    other, viewer = one.session("other"), one.session("viewer")
    looks(one, viewer, FOUR[0])
    one.cells_for(Selected(2, FOUR[:1], wait=30.0), other)
    (segment,) = one.ledger.residents()
    assert (segment.spare, segment.hits) == (False, 1)


def test_it_counts_as_no_use(inner: Inner, small_map: DividedMap) -> None:
    one = inner(small_map.root)
    other, viewer = one.session("other"), one.session("viewer")
    one.cells_for(Selected(1, FOUR[:1], wait=30.0), other)
    (segment,) = one.ledger.residents()
    used_s = segment.last_use_s
    one.offset_s += 5.0
    looks(one, viewer, *FOUR[:2])
    assert (segment.last_use_s, segment.hits) == (used_s, 1)
    assert not one.scheduler.prefetcher.cold

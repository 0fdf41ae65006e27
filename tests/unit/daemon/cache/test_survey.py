# SPDX-License-Identifier: Apache-2.0
"""The survey looks at some segments a step; a session gets the result of a walk that began after it asked."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import cast

import pytest

from shmmap.daemon.cache.holders import MAX_ASKED, UNKNOWN_SLOT, Holders, Survey, Usage
from shmmap.daemon.cache.ledger import Segments
from shmmap.daemon.records import Key, Resident
from shmmap.daemon.transport.sessions import Session, Sessions
from shmmap.errors import Busy
from shmmap.protocol.messages import Selected
from tests.support import connections
from tests.support.divided_map import DividedMap
from tests.unit.daemon.whole_daemon import WholeDaemon

SEGMENTS = 48
pytestmark = pytest.mark.usefixtures("short_steps")


def resident(number: int) -> Resident:
    return Resident(
        f"{number}", Key(f"{number}", "points"), number, 100 + number, 1, (0.0, 0.0, 1.0, 1.0), 0.0, 1.0
    )


class Memory:
    """Segments and their holders; stands for `Holders`."""

    def __init__(self, count: int = SEGMENTS) -> None:
        self.those = [resident(number) for number in range(count)]
        self.segments = Segments()
        for one in self.those:
            self.segments.add(one)
        self.reclaimer = SimpleNamespace(ledger=self)
        self.users: dict[str, list[int]] = {}
        self.looked = 0
        self.by_slot = True

    def has(self, one: Resident, slot: int) -> bool:
        self.looked += 1
        return one not in self.those or slot in self.users.get(one.name, [])

    def slots_of(self, one: Resident) -> list[int]:
        return [slot for slot in self.users.get(one.name, []) if slot != UNKNOWN_SLOT]

    def users_among(self, one: Resident, _slots: list[int]) -> list[int]:
        self.looked += 1
        return self.users.get(one.name, [])


def survey_of(memory: Memory, *, superseded: frozenset[str] = frozenset()) -> Survey:
    return Survey(cast("Holders", memory), in_service=lambda one: one.name not in superseded)


def session() -> Session:
    return Sessions().open(connections.of(), "", 0.0)


def walk(survey: Survey) -> Usage:
    """Step to the end of a walk over all segments."""
    before = survey.usage
    while survey.usage is before:
        survey.step()
    return survey.usage


def test_the_gauges_follow_one_walk_behind() -> None:
    memory = Memory()
    survey = survey_of(memory)
    memory.users = {"1": [7], "2": [UNKNOWN_SLOT], "40": [7, 8]}
    survey.step()
    assert memory.looked == 1
    assert survey.usage == Usage()
    usage = walk(survey)
    assert (usage.count, usage.nbytes) == (3, 101 + 102 + 140)
    memory.users = {"2": [UNKNOWN_SLOT]}
    usage = walk(survey)
    assert (usage.count, usage.nbytes) == (1, 102)
    for one in memory.those:
        memory.segments.remove(one)
    assert walk(survey) == Usage()


@pytest.mark.parametrize("count", [0, SEGMENTS])
def test_the_result_is_of_a_walk_that_began_afterwards(count: int) -> None:
    memory = Memory(count)
    survey = survey_of(memory, superseded=frozenset({"3"}))
    survey.step()  # a walk runs
    memory.users = {"47": [7], "3": [7, UNKNOWN_SLOT]}
    results: list[Usage] = []
    assert survey.next_s == float("inf")
    memory.looked = 0
    survey.run_step(0.0)
    assert memory.looked == 0, "no session asked"
    survey.ask(session(), results.append)
    survey.ask(session(), results.append)
    while not survey.idle:
        survey.step()
    assert memory.looked == count
    assert results[0] is results[1] is survey.usage
    if count:
        share = results[0].shares[7]
        assert (share.mapped_bytes, share.superseded, share.superseded_bytes) == (147 + 103, 1, 103)
        assert (results[0].unknown, results[0].unknown_bytes, results[0].count) == (1, 103, 2)


def test_one_session_waits_for_a_bounded_number_of_results() -> None:
    survey, mine = survey_of(Memory()), session()
    results = list[Usage]()
    for _ in range(MAX_ASKED):
        survey.ask(mine, results.append)
    with pytest.raises(Busy):
        survey.ask(mine, results.append)
    survey.ask(session(), results.append)


def test_a_session_may_leave_while_it_waits_for_many_results(
    whole: Callable[..., WholeDaemon], small_map: DividedMap
) -> None:
    """Its connection ends as any other one does."""
    one = whole(small_map.root)
    assert one.ask(Selected(2, ("0_0.pcd",), wait=30.0)).cells
    (waiting,), (connection,) = one.memory.sessions, one.service._connections
    for _ in range(MAX_ASKED):
        one.memory.cache.survey.ask(waiting, lambda _usage: None)
    connection.end()
    assert list(one.service._connections) == []
    assert list(one.memory.sessions.departed.values()) == [waiting]

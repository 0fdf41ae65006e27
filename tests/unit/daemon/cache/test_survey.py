# SPDX-License-Identifier: Apache-2.0
"""The survey looks at a few segments a step, and whoever asks hears of a walk that began afterwards."""

from __future__ import annotations

from typing import Any, cast

import pytest

from shmmap.daemon.cache import survey
from shmmap.daemon.cache.holders import UNKNOWN_SLOT, Holders
from shmmap.daemon.cache.ledger import Ledger, Segments
from shmmap.daemon.cache.survey import MOST_ASKED, Survey, Usage
from shmmap.daemon.records import Key, Resident
from shmmap.daemon.transport.sessions import Session, Sessions
from shmmap.errors import Busy
from tests.support import connections

LOOKS_AT_ONCE = 16
SEGMENTS = 3 * LOOKS_AT_ONCE


@pytest.fixture(autouse=True)
def _looks_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(survey, "LOOKS_AT_ONCE", LOOKS_AT_ONCE)


def resident(number: int) -> Resident:
    return Resident(
        f"{number}", Key(f"{number}", "points"), number, 100 + number, 1, (0.0, 0.0, 1.0, 1.0), 0.0, 1.0
    )


class Memory:
    """Segments and who maps them; stands for the ledger and the holders."""

    def __init__(self, count: int = SEGMENTS) -> None:
        self.those = [resident(number) for number in range(count)]
        self._segments = Segments()
        for one in self.those:
            self._segments.add(one)
        self.users: dict[str, list[int]] = {}
        self.looked = 0
        self.by_slot = True

    @property
    def segments(self) -> Segments:
        return self._segments

    def has(self, one: Resident, slot: int) -> bool:
        self.looked += 1
        return one not in self.those or slot in self.users.get(one.name, [])

    def slots_of(self, one: Resident) -> list[int] | None:
        if one not in self.those:
            return None
        return [slot for slot in self.users.get(one.name, []) if slot != UNKNOWN_SLOT]

    def users_among(self, one: Resident, slots: list[int]) -> list[int]:
        del slots
        self.looked += 1
        return self.users.get(one.name, [])


def survey_of(memory: Memory, *, superseded: frozenset[str] = frozenset()) -> Survey:
    return Survey(
        cast("Ledger", memory), cast("Holders", memory), in_service=lambda one: one.name not in superseded
    )


def session() -> Session:
    return Sessions().open(connections.of(), "", 0.0)


def test_the_gauges_follow_one_walk_behind() -> None:
    memory = Memory()
    survey = survey_of(memory)
    memory.users = {"1": [7], "2": [UNKNOWN_SLOT], "40": [7, 8]}
    for _ in range(3):
        survey.step()
    assert memory.looked == 3 * LOOKS_AT_ONCE
    assert survey.usage == Usage()
    survey.step()
    assert (survey.usage.count, survey.usage.nbytes) == (3, 101 + 102 + 140)
    memory.users = {"2": [UNKNOWN_SLOT]}
    for _ in range(4):
        survey.step()
    assert (survey.usage.count, survey.usage.nbytes) == (1, 102)
    for one in memory.those:
        memory.segments.remove(one)
    survey.step()
    assert survey.usage == Usage()


def test_who_asks_hears_of_a_walk_that_began_afterwards() -> None:
    memory = Memory()
    survey = survey_of(memory, superseded=frozenset({"3"}))
    survey.step()  # a walk is under way
    memory.users = {"47": [7], "3": [7, UNKNOWN_SLOT]}
    told: list[Usage] = []
    assert survey.next_s == float("inf")
    survey.run_step(0.0)
    assert memory.looked == LOOKS_AT_ONCE, "nobody asked"
    survey.ask(session(), told.append)
    survey.ask(session(), told.append)
    while not survey.idle:
        survey.step()
    assert memory.looked == LOOKS_AT_ONCE + SEGMENTS
    assert told[0] is told[1] is survey.usage
    share = told[0].shares[7]
    assert (share.mapped_bytes, share.superseded, share.superseded_bytes) == (147 + 103, 1, 103)
    assert (told[0].unknown, told[0].unknown_bytes, told[0].count) == (1, 103, 2)


def test_without_segments_the_answer_comes_all_the_same() -> None:
    survey, told = survey_of(Memory(0)), list[Usage]()
    survey.ask(session(), told.append)
    while not survey.idle:
        survey.step()
    assert told == [Usage()]


def test_one_session_waits_for_so_many_answers() -> None:
    survey, mine = survey_of(Memory()), session()

    def nothing(usage: Any) -> None:
        del usage

    for _ in range(MOST_ASKED):
        survey.ask(mine, nothing)
    with pytest.raises(Busy):
        survey.ask(mine, nothing)
    survey.ask(session(), nothing)


def no(*_: object) -> bool:
    return False


def test_a_session_keeps_what_it_maps_or_was_just_given() -> None:
    memory, mine = Memory(4), session()
    mapped, dropped, fresh, gone = memory.those
    mine.hold(memory.those)
    memory.users = {mapped.name: [mine.slot]}
    fresh.last_use_s = 99.5
    memory.those.remove(gone)
    assert list(survey_of(memory).look_at(mine, 99.0, no)) == []
    assert dropped not in mine.residents()
    assert {one.name for one in mine.residents()} == {mapped.name, fresh.name, gone.name}


def test_what_a_session_has_is_looked_up_a_few_at_a_time() -> None:
    """Oldest first, until enough was let go of."""
    memory, mine = Memory(), session()
    mine.hold(memory.those)
    turns = before = 0
    for _ in survey_of(memory).look_at(mine, 99.0, lambda: len(mine.held) <= 10):
        assert memory.looked - before <= LOOKS_AT_ONCE
        before, turns = memory.looked, turns + 1
    assert turns == memory.looked // LOOKS_AT_ONCE == 2
    assert list(mine.held) == [one.version for one in memory.those[-10:]], "and no further"


def test_so_many_of_a_session_s_segments_are_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(survey, "MOST_SEGMENTS", 20)
    memory, mine = Memory(), session()
    mine.hold(memory.those)
    list(survey_of(memory).look_at(mine, 99.0, no))
    assert memory.looked == 20


def test_where_the_kernel_does_not_tell_who_has_what_nothing_is_taken_for_dropped() -> None:
    memory, mine = Memory(), session()
    memory.by_slot = False
    mine.hold(memory.those)
    assert list(survey_of(memory).look_at(mine, 99.0, no)) == []
    assert len(mine.held) == SEGMENTS

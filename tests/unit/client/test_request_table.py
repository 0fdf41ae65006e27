# SPDX-License-Identifier: Apache-2.0
"""The table of outstanding requests alone: its clock and its daemon are lines of a test."""

from __future__ import annotations

from collections.abc import Callable
from queue import SimpleQueue
from typing import Any

import pytest

from shmmap.client.request_table import PLACES, Outstanding, RequestTable
from shmmap.errors import NoAnswer
from shmmap.protocol.codec import encode
from shmmap.protocol.messages import (
    Area,
    Cells,
    CircleMessage,
    ErrorReply,
    Hello,
    PendingCell,
    Released,
    Stats,
)
from tests.support.message_pack import unpack

HERE = CircleMessage(0.0, 0.0, 5.0)


class Driven:
    """A table, its clock, and what was sent."""

    def __init__(self) -> None:
        self.table = RequestTable()
        self.now_s = 100.0
        self.answers: SimpleQueue[Outstanding] = SimpleQueue()

    def ask(self, request: int, wait_s: float = 0.0, timeout_s: float = 5.0) -> Outstanding:
        message: Any = Area(request, HERE, wait=wait_s) if wait_s else Stats(request)
        entry = Outstanding(
            message,
            encode(message),
            self.answers,
            now_s=self.now_s,
            deadline_s=self.now_s + wait_s + timeout_s,
            wait_s=wait_s,
            request=request,
        )
        self.table.add(entry)
        return entry

    def sent(self) -> list[list[Any]]:
        """Send what there is to send."""
        found = []
        while (data := self.table.next_to_send()) is not None:
            found.append(unpack(data))
            self.table.sent(self.now_s)
        return found

    def ids(self) -> list[tuple[str, int]]:
        return [(message[0], message[1]) for message in self.sent()]

    def early(self, request: int) -> bool:
        """The daemon answers at once, for too many wait."""
        pending = (PendingCell("a.pcd", "points"),)
        return self.table.receive(Cells(request, 1, 2, pending=pending), self.now_s)

    def answered(self) -> list[int]:
        """Ids of the requests that have been answered since the last call."""
        found = []
        while not self.answers.empty():
            found.append(self.answers.get().request)
        return found

    def tick(self, seconds: float) -> None:
        self.now_s += seconds
        self.table.tick(self.now_s, lambda entry: NoAnswer(f"{entry.timeout_s:g}"))

    def is_empty(self) -> bool:
        table = self.table
        return not (table.is_busy or table._unsent or table._held or table._waiting)


@pytest.fixture
def one() -> Driven:
    return Driven()


def test_replies_in_any_order(one: Driven) -> None:
    entries = [one.ask(number) for number in (1, 2, 3)]
    assert one.ids() == [("stats", 1), ("stats", 2), ("stats", 3)]
    assert one.ids() == []
    for number in (3, 99, 1, 3, 2):
        assert not one.table.receive(Released(number), one.now_s)
    assert one.answered() == [3, 1, 2]
    assert entries[2].reply == Released(3)
    assert one.is_empty()


def test_silence(one: Driven) -> None:
    """Sent again a second after the wait, then after twice as long each time; until the deadline."""
    entry = one.ask(1, wait_s=2.0)
    one.sent()
    assert one.table.next_s == pytest.approx(103.0)
    seen = []
    while not one.answers.qsize():
        one.tick(0.25)
        seen += [one.now_s - 100.0 for message in one.sent() if message[0] == "area"]
    assert seen == [3.0]
    assert isinstance(entry.reply, NoAnswer)
    assert (entry.reply.message, one.now_s) == ("7", 107.0)
    assert one.is_empty()


def test_a_session_that_is_begun_again(one: Driven) -> None:
    """Nothing else is sent before its welcome, then all of it in order; what was held, too."""
    one.ask(1, timeout_s=50.0)
    for number in (2, 3):
        one.ask(number, wait_s=10.0)
    one.sent()
    one.early(3)
    one.now_s += 4.0
    assert one.table.receive(ErrorReply(1, "no_session", ""), one.now_s)
    hello = Hello(50, 2, 1)
    one.table.begin_session(
        Outstanding(hello, encode(hello), one.answers, now_s=104.0, deadline_s=1e9, wait_s=0.0, request=50),
        one.now_s,
    )
    assert not one.table.receive(ErrorReply(2, "no_session", ""), one.now_s), "it is on its way"
    one.ask(4)
    assert one.ids() == [("hello", 50)]
    one.tick(1.1)
    assert one.ids() == [("hello", 50)]
    one.table.session_begun(Released(50))
    sent = one.sent()
    assert [message[1] for message in sent] == [1, 2, 3, 4]
    assert [message[4] for message in sent[1:3]] == [6.0, 6.0], "what was left of the wait"
    for number in (1, 2, 3, 4):
        one.table.receive(Released(number), one.now_s)
    assert one.is_empty()


def test_more_requests_than_may_wait(one: Driven) -> None:
    """The last ones are asked again, with what is left of their waits, when others end."""
    for number in range(PLACES + 3):
        one.ask(number, wait_s=10.0)
    assert len(one.sent()) == PLACES + 3
    for number in range(PLACES, PLACES + 3):
        one.early(number)
    one.ask(500, wait_s=10.0)
    one.sent()
    one.table.receive(Cells(500, 1, 2), one.now_s)
    assert one.answered() == [500]
    assert one.sent() == [], "it has left no place: 64 wait"
    one.now_s += 2.0
    one.table.receive(Cells(7, 1, 2), one.now_s)
    ((_, number, _, _, wait_s, *_),) = one.sent()
    assert (number, wait_s) == (PLACES, 8.0)
    one.table.withdraw([(8, False)], one.now_s)
    assert one.ids() == [("cancel", 8), ("area", PLACES + 1)]
    one.table.withdraw([(PLACES + 2, False)], one.now_s)
    assert one.sent() == [], "that one was with the daemon no more"
    assert one.answered() == [7]


def test_a_reply_that_is_not_the_last_is_not_early(one: Driven) -> None:
    """It waits for no loads: its client goes on at once."""
    one.ask(1, wait_s=20.0)
    one.ask(2, wait_s=5.0)
    one.sent()
    one.table.receive(Cells(2, 1, 2, pending=(PendingCell("a", "points"),), next="a"), one.now_s)
    assert one.answered() == [2]


def test_one_that_is_held_until_its_wait_is_over(one: Driven) -> None:
    """It is asked a last time, without a wait, for what is there by then."""
    one.ask(1, wait_s=20.0)
    held = one.ask(2, wait_s=5.0)
    one.sent()
    one.early(2)
    one.tick(4.0)
    assert one.sent() == []
    one.tick(1.1)
    ((_, number, _, _, wait_s, *_),) = one.sent()
    assert (number, wait_s) == (2, None)
    one.early(2)
    assert one.answered() == [2]
    assert isinstance(held.reply, Cells)


@pytest.mark.parametrize("others", [0, 1])
def test_an_early_answer_is_the_answer_where_no_place_can_become_free(one: Driven, others: int) -> None:
    for number in range(others):
        one.ask(10 + number, wait_s=10.0)
    one.ask(1, wait_s=10.0)
    one.sent()
    one.early(1)
    assert one.answered() == [1][others:]
    if others:
        one.table.receive(Cells(10, 1, 2), one.now_s)
        assert one.ids() == [("area", 1)]
        one.early(1)
        assert one.answered() == [10, 1]
    assert one.is_empty()


@pytest.mark.parametrize("others", [1, PLACES])
def test_a_place_that_becomes_free_before_one_is_refused(one: Driven, others: int) -> None:
    """The refusal was on its way when another wait ended: that one's place is used, once."""
    for number in range(others):
        one.ask(10 + number, wait_s=10.0)
    one.ask(1, wait_s=10.0)
    one.sent()
    one.table.withdraw([(10, True)], one.now_s)
    assert one.ids() == [("cancel", 10)]
    one.early(1)
    assert one.ids() == [("area", 1)]
    one.early(1)
    assert one.ids() == []
    assert one.answered() == ([1] if others == 1 else [])


def test_one_is_withdrawn_that_was_about_to_use_a_place(one: Driven) -> None:
    for number in range(PLACES + 2):
        one.ask(number, wait_s=10.0)
    one.sent()
    for number in (PLACES, PLACES + 1):
        one.early(number)
    one.table.withdraw([(0, True)], one.now_s)
    one.table.withdraw([(PLACES, True)], one.now_s)
    assert one.ids() == [("cancel", 0), ("area", PLACES + 1)]


def unsent(one: Driven) -> None:
    """Withdrawn before it was sent."""
    one.ask(1, wait_s=5.0)
    one.table.withdraw([(1, True)], one.now_s)
    assert one.sent() == []


def not_waiting(one: Driven) -> None:
    """The answer comes at once in any case."""
    one.ask(1)
    one.sent()
    one.table.withdraw([(1, False)], one.now_s)
    assert one.sent() == []


def unknown(one: Driven) -> None:
    """One that its caller has sent by itself."""
    one.table.withdraw([(1, True)], one.now_s)
    assert one.ids() == [("cancel", 1)]


@pytest.mark.parametrize("act", [unsent, not_waiting, unknown])
def test_withdrawn(one: Driven, act: Callable[[Driven], None]) -> None:
    act(one)
    assert one.answered() == []
    assert one.is_empty()


def test_ten_thousand(one: Driven) -> None:
    """Nothing is looked at as often as there are requests."""
    for number in range(10_000):
        one.ask(number, wait_s=30.0)
    one.sent()
    for number in range(PLACES, 10_000):
        one.early(number)
    for number in range(10_000):
        one.table.withdraw([(number, False)], one.now_s)
        one.sent()
    assert one.answered() == []
    assert one.is_empty()

# SPDX-License-Identifier: Apache-2.0
"""Fair turns: however many requests others pile up, a quiet process waits for one of each of them at most."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from types import SimpleNamespace
from typing import cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmmap.daemon.transport import inbox
from shmmap.daemon.transport.connection import Connection
from shmmap.daemon.transport.inbox import (
    MAX_PER_PROCESS,
    MAX_PROCESS_BYTES,
    MAX_REMEMBERED,
    FairQueue,
    WorkItem,
)


def serve(turns: FairQueue[str], cost_s: float) -> str | None:
    turn = turns.take()
    if turn is None:
        return None
    turns.served(turn[0], cost_s)
    return turn[1]


def test_expensive_requests_wait_longer() -> None:
    turns: FairQueue[str] = FairQueue()
    served: Counter[str] = Counter()
    for _ in range(300):
        for name in ("cheap", "dear"):
            turns.add(name, 0, name, 1)
        turn = turns.take()
        assert turn is not None
        served[turn[1]] += 1
        turns.served(turn[0], 0.010 if turn[1] == "dear" else 0.001)
    assert 8 <= served["cheap"] / served["dear"] <= 12


def test_idling_saves_up_nothing() -> None:
    turns: FairQueue[str] = FairQueue()
    for _ in range(60):
        turns.add("busy", 0, "busy", 1)
    turns.add("idler", 0, "idler", 1)
    serve(turns, 1.0)
    serve(turns, 1.0)
    for _ in range(40):
        assert serve(turns, 1.0) == "busy"
    for _ in range(10):
        turns.add("idler", 0, "idler", 1)
    assert Counter(serve(turns, 1.0) for _ in range(10)) in (
        Counter(busy=5, idler=5),
        Counter(busy=4, idler=6),
    )


def test_connections_of_a_process_take_turns() -> None:
    turns: FairQueue[str] = FairQueue()
    for _ in range(10):
        turns.add("one", "a", "a", 1)
    turns.add("one", "b", "b", 1)
    assert [serve(turns, 1.0) for _ in range(3)] == ["a", "b", "a"]


def test_limits() -> None:
    turns: FairQueue[int] = FairQueue()
    assert sum(turns.add("p", n % 5, n, 1) for n in range(2000)) == MAX_PER_PROCESS
    assert turns.add("q", 0, 0, 2 * MAX_PROCESS_BYTES)  # a single one always may
    assert not turns.add("q", 1, 0, 1)
    assert len(turns) == MAX_PER_PROCESS + 1


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 2), st.floats(0.001, 1.0), st.booleans())))
def test_everything_accepted_is_served_once_in_order(steps: list[tuple[int, int, float, bool]]) -> None:
    turns: FairQueue[tuple[int, int, int]] = FairQueue()
    waiting: dict[tuple[int, int], list[int]] = {}
    for number, (process, connection, cost_s, take) in enumerate(steps):
        if turns.add(process, connection, (process, connection, number), 1):
            waiting.setdefault((process, connection), []).append(number)
        if take:
            turn = turns.take()
            assert turn is not None
            of, (owner, channel, item) = turn
            assert of == owner
            assert waiting[owner, channel].pop(0) == item
            turns.served(of, cost_s)
        assert len(turns) == sum(map(len, waiting.values()))
    while (turn := turns.take()) is not None:
        assert waiting[turn[1][:2]].pop(0) == turn[1][2]
        turns.served(turn[0], 0.1)
    assert not any(waiting.values())


@pytest.mark.parametrize("loud", [1, 3, 20])
def test_the_quiet_one_waits_for_each_loud_one_once(loud: int) -> None:
    turns: FairQueue[str] = FairQueue()
    for number in range(loud):
        for _ in range(64):
            turns.add(number, 0, "loud", 1)
    for _ in range(5 * loud):
        serve(turns, 0.01)
    turns.add("quiet", 0, "quiet", 1)
    before = 0
    while serve(turns, 0.01) != "quiet":
        before += 1
    assert before <= loud


def test_what_must_be_answered_is_never_refused() -> None:
    turns: FairQueue[str] = FairQueue()
    for _ in range(MAX_PER_PROCESS):
        assert turns.add("p", "c", "loud", 0)
    assert not turns.add("p", "c", "more", 0)
    assert turns.add("p", "c", "answer", 0, always=True)
    assert turns.add("q", "d", "quiet", 0)
    assert "quiet" in [serve(turns, 1.0) for _ in range(3)], "no process waits for a loud one's answers"


def test_what_comes_for_a_process_while_it_is_served() -> None:
    """An answer may be due because of the request that is being served: it has one turn, not two."""
    turns: FairQueue[str] = FairQueue()
    turns.add("p", "c", "first", 0)
    turn = turns.take()
    assert turn == ("p", "first")
    turns.add("p", "c", "answer", 0, always=True)
    turns.served("p", 0.1)
    assert [serve(turns, 1.0), serve(turns, 1.0), len(turns)] == ["answer", None, 0]


def test_what_has_begun_goes_on_before_anything_else_of_its_process() -> None:
    turns: FairQueue[str] = FairQueue()
    turns.add("p", "a", "long", 5)
    turns.add("p", "b", "short", 5)
    turns.add("q", "c", "other", 5)
    order = []
    for _ in range(6):
        taken = turns.take()
        assert taken is not None
        order.append(taken[1])
        again = taken[1] if taken[1] == "long" and order.count("long") < 4 else None
        turns.served(taken[0], 1.0, again)
    assert order == ["long", "other", "long", "long", "long", "short"]
    assert (len(turns), turns.take()) == (0, None)


def test_what_has_begun_is_remembered_however_many_come() -> None:
    turns: FairQueue[str] = FairQueue()
    turns.add("p", "a", "long", 5)
    assert turns.take() == ("p", "long")
    turns.served("p", 100.0, "long")
    for number in range(MAX_REMEMBERED + 10):
        turns.add(number, 0, "other", 1)
        assert serve(turns, 0.0) == "other"
    assert len(turns._lines) <= MAX_REMEMBERED, "idle processes are forgotten"
    assert turns.take() == ("p", "long")


@pytest.mark.parametrize(("step_s", "steps"), [(0.0, 10), (60.0, 0)])
def test_work_pauses_when_its_step_has_taken_long(
    step_s: float, steps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inbox, "STEP_S", step_s)
    done = []

    def work() -> Iterator[None]:
        for number in range(10):
            done.append(number)
            yield

    connection = cast("Connection", SimpleNamespace(open=True))
    item, paused = WorkItem(connection, work=work(), is_request=False), 0
    item.run_step()
    while not item.is_done:
        paused += 1
        assert len(done) == paused
        item.run_step()
    assert (paused, len(done)) == (steps, 10)

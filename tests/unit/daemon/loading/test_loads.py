# SPDX-License-Identifier: Apache-2.0
"""Loads in fair turns: nearest first for each, and no client waits for all that another one asked for."""

from __future__ import annotations

from collections.abc import Hashable
from itertools import count

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmmap.daemon.cache.ledger import Ledger
from shmmap.daemon.loading.loads import (
    BACKGROUND,
    COMPUTED,
    FETCHED,
    Attempt,
    FailedFileCheck,
    LeftoverCheck,
    Load,
    LoadQueue,
    Loads,
    Purpose,
)
from shmmap.daemon.records import Key, Resident

_numbers = count()


def load(nbytes: int = 1 << 20, asker: Hashable = None) -> Load:
    return Load(Key("", ""), nbytes, 0.0, next(_numbers), asker=asker)


def start(queue: LoadQueue) -> Load | None:
    one = queue.choose()
    if one is not None:
        queue.start(one)
    return one


def test_a_newcomer_waits_for_one_of_anothers() -> None:
    queue = LoadQueue()
    greedy = [load() for _ in range(100)]
    for one in greedy:
        queue.push(one, 0.0, "greedy")
    assert [start(queue) for _ in range(5)] == greedy[:5]
    far = [load(), load()]
    for one in far:
        queue.push(one, 500.0, "modest")
    served = [start(queue) for _ in range(4)]
    assert set(far) < set(served)


def test_turns_are_by_bytes() -> None:
    queue = LoadQueue()
    large = [load(32 << 20) for _ in range(10)]
    small = [load(1 << 20) for _ in range(200)]
    for one in large:
        queue.push(one, 0.0, "large")
    for one in small:
        queue.push(one, 0.0, "small")
    served = [start(queue) for _ in range(100)]
    assert 3 <= sum(one in large for one in served) <= 5


def test_a_tiny_load_costs_more_than_its_bytes() -> None:
    """A tenth of what a megabyte costs, not a millionth."""
    queue = LoadQueue()
    large = [load(1_000_000) for _ in range(20)]
    for one in large:
        queue.push(one, 0.0, "large")
    for _ in range(200):
        queue.push(load(1), 0.0, "tiny")
    served = [start(queue) for _ in range(100)]
    assert 7 <= sum(one in large for one in served) <= 10


def test_turns_are_by_the_time_that_loads_took_in_the_end() -> None:
    """Small files whose layers take seconds; their client waits while the other one is served."""
    queue = LoadQueue()
    for _ in range(20):
        queue.push(load(1 << 10, "slow"), 0.0, "slow")
        queue.push(load(1 << 20, "quick"), 0.0, "quick")
    served: list[Hashable] = []
    for _ in range(12):
        one = start(queue)
        assert one is not None
        served.append(one.asker)
        queue.end(one, 8.0 if one.asker == "slow" else 1.0)
    assert served.count("slow") == 2
    assert served.count("quick") == 10


def test_a_debt_is_remembered_while_others_wait() -> None:
    """A client that asks for one slow layer after the other still owes the time of the last one."""
    queue = LoadQueue()
    queue.push(load(asker="slow"), 0.0, "slow")
    for _ in range(10):
        queue.push(load(asker="quick"), 0.0, "quick")
    served: list[Hashable] = []
    while (one := start(queue)) is not None:
        served.append(one.asker)
        queue.end(one, 5.0 if one.asker == "slow" else 1.0)
        if one.asker == "slow":
            queue.push(load(asker="slow"), 0.0, "slow")
        if len(served) == 11:
            break
    assert served.count("slow") == 2
    queue = LoadQueue()
    for asker in ("slow", "quick"):  # no client waited in between: nothing is owed
        queue.push(one := load(), 0.0, asker)
        assert start(queue) is one
        queue.end(one, 5.0)
        assert queue.choose() is None
    queue.push(load(asker="slow"), 1.0, "slow")
    queue.push(load(asker="quick"), 2.0, "quick")
    first = start(queue)
    assert first is not None
    assert first.asker == "slow"


def test_what_goes_back_costs_nothing() -> None:
    """Its loader died of another one's job."""
    queue = LoadQueue()
    first, second = load(1 << 30), load(1 << 10)
    queue.push(first, 0.0, "a")
    queue.push(second, 1.0, "b")
    assert start(queue) is first
    queue.end(first, 0.0)
    queue.push(first, 0.0, "a")
    assert start(queue) is first


def test_points_pass_layers_that_no_loader_can_take() -> None:
    queue = LoadQueue()
    layer, points = load(), load()
    layer.kind = COMPUTED
    queue.push(layer, 0.0, "a")
    queue.push(points, 9.0, "a")
    assert queue.choose(layers=False) is points
    assert queue.choose(points=False) is layer
    assert queue.choose(points=False, layers=False) is None
    assert queue.choose() is layer


def test_what_needs_no_link_passes_what_waits_for_it() -> None:
    """Which keeps its place, of each asker."""
    queue = LoadQueue()
    first, fetched, free = load(), load(), load()
    first.kind = fetched.kind = FETCHED
    queue.push(first, 0.0, "a")
    queue.push(fetched, 1.0, "a")
    queue.push(fetched, 2.0, "b")
    queue.push(free, 3.0, "a")
    assert queue.choose(link=False) is free
    queue.discard(free)
    assert queue.choose(link=False) is None
    assert start(queue) is first
    assert start(queue) is fetched
    assert queue.choose() is None


def test_what_no_request_waits_for_comes_last() -> None:
    queue = LoadQueue()
    check, asked = load(0), load()
    queue.push(check, float("inf"), None)
    queue.push(asked, BACKGROUND / 2, "a")
    assert start(queue) is asked
    assert start(queue) is check


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["push", "again", "start", "discard"]),
            st.integers(0, 3),
            st.integers(0, 99),
        )
    )
)
def test_everything_comes_once_and_nearest_first_of_each(steps: list[tuple[str, int, int]]) -> None:
    queue = LoadQueue()
    waiting: dict[Load, dict[int, int]] = {}
    for what, asker, number in steps:
        chosen = list(waiting)[number % len(waiting)] if waiting else None
        if what == "push" or chosen is None:
            one = load()
            one.kind = number % 4
            queue.push(one, number, asker)
            waiting[one] = {asker: number}
        elif what == "again":
            queue.push(chosen, number, asker)
            waiting[chosen][asker] = min(number, waiting[chosen].get(asker, number))
        elif what == "discard":
            queue.discard(chosen)
            del waiting[chosen]
        else:
            started = start(queue)
            assert started in waiting
            mine = waiting.pop(started)
            assert any(
                all(priority <= other[asker] for other in waiting.values() if asker in other)
                for asker, priority in mine.items()
            ), "one client's nearest"
        assert len(queue) == len(waiting)


# --- what a load is for -----------------------------------------------------------------------------------

KEY = Key("/map/0.pcd", "points")


def leftover() -> Resident:
    return Resident("/shmmap.x.1", KEY, 1, 4096, 1, (0.0, 0.0, 1.0, 1.0), 0.0, 1.0, checked=False)


@pytest.fixture
def loads() -> Loads:
    return Loads(Ledger(1 << 20))


@pytest.mark.parametrize("runs", [False, True])
def test_a_demand_takes_over_what_was_loaded_ahead(loads: Loads, runs: bool) -> None:
    wish = loads.prefetch(KEY, 100, 5.0)
    assert (wish.work, wish.is_ahead) == (Purpose.WISH, True)
    if not runs:
        assert loads.spare(KEY, 100, "a") is wish
        assert (wish.work, wish.is_ahead) == (Purpose.SPARE, True)
    elif loads.queue.choose() is wish:
        assert loads.start(wish, Attempt(0.0))
    assert loads.want(KEY, 100, 3.0, "b") is wish
    assert (wish.work, wish.is_ahead, wish.is_running) == (Purpose.DEMAND, False, runs)
    assert loads.prefetch(KEY, 100, 5.0) is wish
    assert wish.work is Purpose.DEMAND


def test_a_check_stays_one_when_its_cell_is_asked_for(loads: Loads) -> None:
    resident = leftover()
    loads.check_leftover(resident)
    check = loads.by_key[KEY]
    assert check.work == LeftoverCheck(resident, is_asked_for=False)
    assert loads.want(KEY, 100, 3.0, "a") is check
    assert (check.work, check.estimate, check.priority) == (LeftoverCheck(resident, True), 0, 3.0)
    assert loads.is_promised(KEY)
    loads.finish(check)
    failed = loads.check_failed_file(KEY, 3.0, "a", bytes(24))
    assert loads.want(KEY, 100, 2.0, "b") is failed
    assert (failed.work, loads.is_promised(KEY)) == (FailedFileCheck(bytes(24)), False)


@pytest.mark.parametrize("runs", [False, True])
@pytest.mark.parametrize("is_wish", [False, True])
def test_a_leftover_that_is_found_late_is_checked_instead_of_loaded(
    loads: Loads, runs: bool, is_wish: bool
) -> None:
    """A page of the map had to come first; a load that runs already supersedes it."""
    load = loads.prefetch(KEY, 100, 5.0) if is_wish else loads.want(KEY, 100, 3.0, "a")
    before = load.work
    if runs and loads.queue.choose() is load:
        assert loads.start(load, Attempt(0.0))
    resident = leftover()
    loads.check_leftover(resident)
    assert loads.by_key == {KEY: load}
    assert load.work == (before if runs else LeftoverCheck(resident, is_asked_for=not is_wish))
    assert load.estimate == (100 if runs else 0)

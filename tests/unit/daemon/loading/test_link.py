# SPDX-License-Identifier: Apache-2.0
"""The budget of a link, in simulated time."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import pytest

from shmmap.daemon.loading.link import FIRST_BYTES, STALLED_S, UNDER_WAY_S, Link
from shmmap.daemon.map.arrivals import Arrivals

MBIT_20 = 2.5e6
CELL = 350_000
TICK_S = 0.01


@dataclass(eq=False)
class Wire:
    """A link that carries ``rate`` bytes a second, one object after the other, each ``delay_s`` later."""

    link: Link
    rate: float = MBIT_20
    delay_s: float = 0.05
    now_s: float = 100.0
    queue: deque[tuple[int, float, float]] = field(default_factory=deque)  # key, left, begins
    number: int = 0
    done: list[tuple[int, float]] = field(default_factory=list)

    def ask(self, nbytes: int = CELL, *, ahead: bool = False) -> int | None:
        """Ask for an object if the link has room; return its number."""
        if not self.link.may_begin(self.now_s, ahead=ahead):
            return None
        self.number += 1
        self.link.begin(self.number, nbytes, self.now_s, "ahead" if ahead else "demand")
        self.queue.append((self.number, float(nbytes), self.now_s + self.delay_s))
        return self.number

    def fill(self, nbytes: int = CELL, *, ahead: bool = False) -> int:
        """Ask for as many objects as may be under way; return how many."""
        count = 0
        while self.ask(nbytes, ahead=ahead) is not None:
            count += 1
        return count

    def tick(self, *, out: bool = False) -> None:
        """Let a hundredth of a second pass."""
        self.now_s += TICK_S
        left, came = self.rate * TICK_S, 0.0
        while not out and self.queue and left > 0.0 and self.queue[0][2] <= self.now_s:
            key, bytes_left, begins_s = self.queue.popleft()
            taken = min(left, bytes_left)
            left, came = left - taken, came + taken
            if taken < bytes_left:
                self.queue.appendleft((key, bytes_left - taken, begins_s))
            else:
                self.link.arrived(round(came), self.now_s, (self.delay_s,))
                came = 0.0
                self.link.end(key, CELL)
                self.done.append((key, self.now_s))
        self.link.arrived(round(came), self.now_s)

    def run(self, seconds: float, *, ahead: bool = False, nbytes: int = CELL, out: bool = False) -> None:
        """Keep the link as busy as it may be."""
        for _ in range(round(seconds / TICK_S)):
            self.fill(nbytes, ahead=ahead)
            self.tick(out=out)

    @property
    def committed_s(self) -> float:
        """How long the link takes for what is under way."""
        return sum(left for _, left, _ in self.queue) / self.rate


def test_half_a_second_is_under_way_and_the_link_is_never_idle() -> None:
    wire = Wire(Link(Arrivals()))
    wire.run(5.0)
    assert wire.link.rate_bytes_s == pytest.approx(MBIT_20, rel=0.05)
    before = len(wire.done)
    for _ in range(500):
        wire.fill()
        assert wire.queue
        assert wire.committed_s <= UNDER_WAY_S + CELL / MBIT_20
        wire.tick()
    assert (len(wire.done) - before) * CELL >= 0.97 * 5.0 * MBIT_20


def test_at_the_beginning_it_grows_fast_enough_for_a_wide_link_and_one_that_answers_late() -> None:
    for rate, delay_s in ((125e6, 0.05), (125e6, 0.4), (MBIT_20, 0.4), (12.5e6, 1.0)):
        wire = Wire(Link(Arrivals()), rate=rate, delay_s=delay_s)
        assert wire.fill(20_000) == -(-FIRST_BYTES // 20_000)
        wire.run(6.0 + 4.0 * delay_s, nbytes=20_000)
        came = len(wire.done)
        wire.run(2.0, nbytes=20_000)
        assert (len(wire.done) - came) * 20_000 > 0.85 * 2.0 * min(rate, 20e6), (rate, delay_s)


def test_an_object_is_always_fetched_however_large_it_is() -> None:
    wire = Wire(Link(Arrivals()), rate=1e4)
    assert wire.fill(8 << 20, ahead=True) == 1
    slow = Wire(Link(Arrivals()), rate=125e3)
    slow.run(10.0)
    assert slow.link.limit_bytes(slow.now_s) < CELL
    assert len(slow.queue) >= 1


def test_wishes_leave_half_to_demands() -> None:
    wire = Wire(Link(Arrivals()))
    wire.run(5.0, ahead=True)
    wire.fill(ahead=True)
    assert wire.committed_s <= 0.5 * UNDER_WAY_S + CELL / MBIT_20
    assert wire.ask() is not None, "a demand still fits"
    wire.fill()
    assert wire.ask(ahead=True) is None
    assert wire.link.received == {"demand": 0, "ahead": CELL * len(wire.done), "index": 0}


def test_demands_behind_another_client_s_wishes_take_as_long_as_alone() -> None:
    def took_s(wishes: int) -> float:
        wire = Wire(Link(Arrivals()))
        wire.run(3.0, ahead=True)
        while wire.queue:
            wire.tick()
        for _ in range(wishes):
            wire.ask(ahead=True)
        begin_s, left = wire.now_s, 24
        mine: set[int] = set()
        while len(mine & {key for key, _ in wire.done}) < 24:
            while left and (key := wire.ask()) is not None:
                mine.add(key)
                left -= 1
            wire.tick()
        return wire.now_s - begin_s

    assert took_s(36) <= 1.2 * took_s(0)


def test_an_outage_changes_nothing_of_the_rate() -> None:
    wire = Wire(Link(Arrivals()))
    wire.run(5.0)
    limit = wire.link.limit_bytes(wire.now_s)
    under_way = len(wire.queue)
    wire.run(60.0, out=True)
    assert wire.link.limit_bytes(wire.now_s) == limit
    assert len(wire.queue) <= under_way + 60.0 / STALLED_S + 1
    wire.queue.clear()
    for key in range(wire.number + 1):
        wire.link.end(key)
    assert wire.link.under_way_bytes == 0
    came = len(wire.done)
    wire.run(2.0)
    assert (len(wire.done) - came) * CELL > 0.8 * 2.0 * MBIT_20


def test_a_link_that_gets_narrower_has_a_smaller_budget_after_ten_seconds() -> None:
    wire = Wire(Link(Arrivals()), rate=12.5e6)
    wire.run(5.0)
    wire.rate = MBIT_20
    wire.run(15.0)
    assert wire.link.rate_bytes_s == pytest.approx(MBIT_20, rel=0.05)


def test_answers_that_drip_hold_up_no_others() -> None:
    wire = Wire(Link(Arrivals()))
    wire.run(3.0)
    while wire.queue:
        wire.tick()
    link, begun = wire.link, 0
    while link.may_begin(wire.now_s, ahead=False):
        link.begin(f"drips {begun}", CELL, wire.now_s, "demand")
        begun += 1
    assert begun > 1
    for _ in range(round((STALLED_S + 0.1) / TICK_S)):
        wire.now_s += TICK_S
        link.arrived(100, wire.now_s)
    assert link.under_way_bytes >= link.limit_bytes(wire.now_s)
    assert wire.ask() is not None
    for _ in range(1000):  # as others come, these count no more
        wire.ask()
        wire.tick()
    assert link.under_way_bytes <= link.limit_bytes(wire.now_s) + CELL
    assert len(wire.done) * CELL > 0.8 * 10.0 * MBIT_20


def test_what_comes_from_the_disk_uses_nothing() -> None:
    link = Link(Arrivals(), cap_bytes_s=1e5)
    for key in range(1000):
        assert link.may_begin(50.0, ahead=False)
        link.begin(key, CELL, 50.0, "demand")
        link.end(key, 0)
    assert (link.under_way_bytes, link.rate_bytes_s) == (0, 0.0)


def test_what_comes_from_the_disk_in_an_outage_comes_at_once() -> None:
    wire = Wire(Link(Arrivals()))
    wire.run(3.0)
    wire.fill()
    wire.now_s += STALLED_S
    for key in range(100):
        assert wire.link.may_begin(wire.now_s, ahead=False)
        wire.link.begin(("disk", key), CELL, wire.now_s, "demand")
        wire.link.end(("disk", key), 0)


def test_an_object_that_is_asked_for_twice_counts_once() -> None:
    link = Link(Arrivals())
    link.begin("cell", CELL, 1.0, "ahead")
    link.begin("cell", CELL, 2.0, "ahead")
    assert link.under_way_bytes == CELL
    link.end("cell")
    link.end("cell")
    assert link.under_way_bytes == 0


def test_a_process_that_stood_still_keeps_the_rate() -> None:
    wire = Wire(Link(Arrivals()))
    wire.run(12.0)
    before = wire.link.rate_bytes_s
    wire.now_s += 20.0
    wire.run(0.5)
    assert wire.link.rate_bytes_s >= 0.9 * before


def test_a_limit_of_the_rate_is_kept() -> None:
    wire = Wire(Link(Arrivals(), cap_bytes_s=1e6))
    wire.run(30.0)
    assert 0.93 * 30e6 <= len(wire.done) * CELL <= 30e6 + 2 * CELL
    assert wire.ask() is None
    assert wire.now_s < wire.link.next_s() <= wire.now_s + CELL / 1e6 + 0.01
    assert wire.link.rests_until_s == wire.link.next_s()


def test_metered_is_for_demands_alone() -> None:
    link = Link(Arrivals(), metered=True)
    assert not link.may_begin(1.0, ahead=True)
    assert link.may_begin(1.0, ahead=False)
    assert not link.is_idle(1.0)
    assert Link(Arrivals()).is_idle(1.0)


def test_pages_count_while_they_come_and_their_bytes_are_index() -> None:
    arrivals = Arrivals()
    link = Link(arrivals)
    arrivals.add_pages(FIRST_BYTES)
    assert link.under_way_bytes == FIRST_BYTES
    assert not link.may_begin(1.0, ahead=True)
    link.update(1.0)
    for tick in range(1, 101):
        arrivals.add_index(FIRST_BYTES // 100)
        link.update(1.0 + 0.01 * tick)
    arrivals.add_pages(-FIRST_BYTES)
    assert link.received["index"] == FIRST_BYTES // 100 * 100
    assert link.rate_bytes_s == pytest.approx(FIRST_BYTES, rel=0.1)
    assert link.may_begin(2.0, ahead=True)


def test_nothing_that_is_idle_asks_for_pages_while_an_object_is_under_way() -> None:
    link = Link(Arrivals())
    link.begin("cell", CELL, 1.0, "ahead")
    assert not link.is_idle(1.0)
    link.end("cell")
    link.end("cell")
    assert link.is_idle(1.0)
    assert link.under_way_bytes == 0

# SPDX-License-Identifier: Apache-2.0
"""Getting memory back: a few segments at a time, large ones in another thread, every byte counted."""

from __future__ import annotations

import mmap
import os
import random
import select
import threading
from collections.abc import Iterator, Sequence
from types import SimpleNamespace
from typing import Any

import pytest

from shmmap.daemon.cache import eviction_plan, reclaimer
from shmmap.daemon.cache.eviction_plan import (
    BLOCK,
    HAND_OUT_GRACE_S,
    LIST_WORK,
    LOOK_WORK,
    MAX_LISTED,
    SQUARE_WORK,
    WORK_PER_STEP,
)
from shmmap.daemon.cache.evictor import LOOKS_PER_CALL, PLAN_S, PRESSURE_S, Evictor, Freeing
from shmmap.daemon.cache.ledger import Ledger, Square
from shmmap.daemon.cache.reclaimer import LOOKS_PER_TURN, TICK_S, Reclaimer
from shmmap.daemon.pins.watch import PinWatch
from shmmap.daemon.records import Key, Resident
from shmmap.daemon.transport.sessions import Sessions
from shmmap.daemon.travel import places
from shmmap.daemon.travel.places import WORK_S
from shmmap.protocol.messages import Intent
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.pins import prepare_process
from tests.support import connections

SMALL, LARGE = 4096, 1 << 20


class Memory:
    """The parts that make room, over real files; ``looks`` counts questions to the kernel."""

    def __init__(self, directory: ShmDirectory, monkeypatch: pytest.MonkeyPatch) -> None:
        prepare_process()
        self.directory = directory
        self.ledger = Ledger(1 << 40)
        self.pins = PinWatch(directory, events=True)
        nothing: Any = SimpleNamespace(segment_retired=lambda *_: None)
        self.reclaimer = Reclaimer(self.ledger, directory, Sessions(), self.pins, nothing)
        self.evictor = Evictor(self.reclaimer)
        self.looks = 0
        look = PinWatch.is_used_elsewhere

        def counted(pins: PinWatch, fd: int) -> bool:
            self.looks += 1
            return look(pins, fd)

        monkeypatch.setattr(PinWatch, "is_used_elsewhere", counted)

    def publish(self, count: int, nbytes: int = SMALL, *, prefetched: bool = False) -> list[Resident]:
        made = []
        for number in range(len(self.ledger.segments), len(self.ledger.segments) + count):
            name = f"/shmmap.unit.{number:016x}"
            fd = self.directory.create()
            os.posix_fallocate(fd, 0, nbytes)
            self.directory.link(fd, name)
            os.close(fd)
            box = (0.0, 0.0, 1.0, 1.0)
            key = Key(f"{number}", "points")
            made.append(Resident(name, key, number, nbytes, 1, box, 0.0, 1.0, prefetched=prefetched))
            self.ledger.enter(made[-1])
        return made

    def move(self, resident: Resident, x: float) -> None:
        """Have it lie elsewhere."""
        self.ledger.evictable.leave(resident)
        resident.box = (x, 0.0, x + 20.0, 20.0)
        self.ledger.evictable.enter(resident)

    def map(self, resident: Resident) -> mmap.mmap:
        with self.directory.opened(self.reclaimer.name_on_disk(resident)) as fd:
            return mmap.mmap(fd, SMALL, prot=mmap.PROT_READ)

    def wait_for_the_thread(self) -> int:
        assert select.select([self.reclaimer.closer.fd], [], [], 10.0)[0]
        return self.reclaimer.collect()

    def until_it_waits(self, shortage: int, now_s: float = 100.0) -> list[int]:
        """Make room until that is done or there is nothing to do; how many looks were taken each time."""
        looks = []
        while True:
            self.looked()
            self.evictor.free(shortage, now_s)
            looks.append(self.looked())
            if self.evictor.wake_s != now_s:
                return looks

    def looked(self) -> int:
        looks, self.looks = self.looks, 0
        return looks


@pytest.fixture
def memory(shm: ShmDirectory, monkeypatch: pytest.MonkeyPatch) -> Iterator[Memory]:
    one = Memory(shm, monkeypatch)
    yield one
    one.reclaimer.remove_all()
    one.reclaimer.close()


NOW_S = 100.0


def test_a_large_segment_s_memory_counts_until_it_is_free(
    memory: Memory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is unlinked in the loop, and closed in the thread that is named for it; a small one here."""
    may_close, closed_in, held = threading.Event(), list[str](), list[tuple[int, int]]()
    close = os.close

    def held_up(fd: int) -> None:
        state = os.fstat(fd)
        held.append((state.st_nlink, state.st_blocks * 512))
        closed_in.append(threading.current_thread().name)
        may_close.wait(10.0)
        close(fd)

    monkeypatch.setattr(reclaimer, "os", SimpleNamespace(**{**vars(os), "close": held_up}))
    (small,), (large,) = memory.publish(1), memory.publish(1, LARGE)
    for resident in (small, large):
        assert memory.reclaimer.retire(resident, NOW_S)
    ledger = memory.ledger
    assert ledger.coming_bytes == ledger.used_bytes == SMALL + LARGE
    assert memory.reclaimer.sweep(NOW_S + TICK_S) == SMALL
    assert not ledger.retired
    assert os.listdir(memory.directory.path) == []
    assert (ledger.used_bytes, ledger.freeing_bytes, ledger.coming_bytes) == (LARGE, LARGE, LARGE)
    assert memory.reclaimer.collect() == 0
    assert memory.evictor.free(LARGE, NOW_S) is Freeing.ENOUGH, "it will come"
    may_close.set()
    assert memory.wait_for_the_thread() == LARGE
    assert (ledger.used_bytes, ledger.freeing_bytes, ledger.retired_bytes) == (0, 0, 0)
    assert closed_in == ["shmmap-freeing"]
    assert held == [(0, LARGE)], "it had no name, but all its memory"


def test_the_number_that_wait_to_be_closed_is_bounded(
    memory: Memory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The others keep their names, and count, until there is room for them."""
    monkeypatch.setattr(reclaimer, "MAX_WAITING", 3)
    monkeypatch.setattr(reclaimer.Closer, "_run", lambda _: None)  # nothing is closed
    large = memory.publish(5, LARGE)
    for resident in large:
        memory.reclaimer.retire(resident, NOW_S)
    memory.reclaimer.sweep(NOW_S + TICK_S)
    assert (len(memory.ledger.retired), memory.ledger.freeing_bytes) == (2, 3 * LARGE)
    assert len(os.listdir(memory.directory.path)) == 2
    assert memory.ledger.coming_bytes == memory.ledger.used_bytes == 5 * LARGE
    waiting = memory.reclaimer.closer._to_close
    while not waiting.empty():
        item = waiting.get()
        assert item is not None
        os.close(item[0])


def test_what_a_client_releases_is_looked_at_a_few_at_a_time(memory: Memory) -> None:
    """However much that is: as it says, as the kernel reports, and when the kernel lost reports."""
    some = memory.publish(3 * LOOKS_PER_TURN)
    mapped = [memory.map(resident) for resident in some]
    for resident in some:
        assert not memory.reclaimer.retire(resident, NOW_S)
    while memory.reclaimer.next_sweep_s() <= NOW_S + TICK_S:
        memory.looked()
        memory.reclaimer.sweep(NOW_S + TICK_S)
        assert memory.looked() == LOOKS_PER_TURN
    later_s = NOW_S + TICK_S + 1e-4
    assert memory.reclaimer.next_sweep_s() > later_s
    memory.looked()
    for one in mapped[:LOOKS_PER_TURN]:
        one.close()
    memory.reclaimer.release(some[: 2 * LOOKS_PER_TURN], later_s)
    assert memory.looked() == 0
    memory.reclaimer.sweep(later_s)
    assert memory.looked() == LOOKS_PER_TURN
    assert len(memory.ledger.retired) == 2 * LOOKS_PER_TURN
    for one in mapped:
        one.close()
    memory.pins.closed = lambda: None  # type: ignore[method-assign]
    assert memory.reclaimer.on_closes(later_s)
    assert memory.looked() == 0
    for _ in range(8):
        memory.reclaimer.sweep(later_s)
        assert memory.looked() <= LOOKS_PER_TURN
    assert not memory.ledger.retired


def test_outdated_checks_are_dropped_some_at_a_time(memory: Memory) -> None:
    """A segment is checked more often than it is released: here each is rescheduled many times."""
    (one,) = memory.publish(1)
    mapped = memory.map(one)
    assert not memory.reclaimer.retire(one, NOW_S)
    retired = memory.ledger.retired[one.name]
    for _ in range(3 * reclaimer.DROPPED_PER_LOOK):
        memory.reclaimer._look_at(retired, NOW_S + 1.0)
        memory.reclaimer._look_at(retired, NOW_S + 2.0)
    mapped.close()
    for _ in range(3):
        assert memory.reclaimer.next_sweep_s() <= NOW_S + 1.0
        assert memory.reclaimer.sweep(NOW_S + 1.5) == 0
    while memory.reclaimer.next_sweep_s() <= NOW_S + 1.5:
        assert memory.reclaimer.sweep(NOW_S + 1.5) == 0
    assert memory.looked() <= 1
    assert memory.reclaimer.sweep(NOW_S + 2.0) == SMALL


def test_nothing_is_freed_before_its_tick_is_over(memory: Memory) -> None:
    """A process may be just opening it, whichever releases it meanwhile."""
    (one,) = memory.publish(1)
    mapped = memory.map(one)
    assert not memory.reclaimer.retire(one, NOW_S)
    mapped.close()
    memory.reclaimer.release([one], NOW_S)
    memory.reclaimer.on_closes(NOW_S)
    assert memory.reclaimer.sweep(NOW_S + TICK_S / 2) == 0
    assert memory.reclaimer.sweep(NOW_S + TICK_S) == SMALL


def test_room_is_made_by_a_few_looks_a_turn(memory: Memory) -> None:
    """Past whatever is mapped, needed or was just handed out, which is not looked at each time."""
    memory.ledger.budget_bytes = 0
    used = memory.publish(2 * LOOKS_PER_CALL)
    mapped = [memory.map(resident) for resident in used]
    needed, free = memory.publish(3), memory.publish(3)
    for number, resident in enumerate((*used, *needed, *free)):
        resident.last_use_s = number / 1e3
    for resident in needed:
        memory.ledger.need(resident.key)
    missing = len(free) * SMALL
    looks = memory.until_it_waits(missing)
    assert sum(looks) == len(used) + 2 * len(free)  # once more when it has another name
    assert max(looks) == LOOKS_PER_CALL
    assert list(memory.ledger.retired) == [one.name for one in free]
    assert memory.evictor.free(missing + SMALL, NOW_S) is Freeing.NO_MORE
    assert memory.looked() == 0, "nothing has changed"
    memory.ledger.need_no_more(needed[0].key)
    mapped[0].close()
    memory.reclaimer.release(used[:1], NOW_S)
    memory.until_it_waits(memory.ledger.coming_bytes + 2 * SMALL)
    assert {needed[0].name, used[0].name} <= set(memory.ledger.retired)
    needed[1].last_use_s = NOW_S
    memory.ledger.need_no_more(needed[1].key)
    memory.until_it_waits(memory.ledger.coming_bytes + SMALL)
    assert memory.evictor.wake_s == NOW_S + HAND_OUT_GRACE_S
    assert needed[1].name not in memory.ledger.retired
    memory.looked()
    assert memory.evictor.free(memory.ledger.coming_bytes + SMALL, NOW_S) is Freeing.LATER
    assert memory.evictor.wake_s == NOW_S + HAND_OUT_GRACE_S
    assert memory.looked() == 1, "it waits for that one"
    memory.ledger.need_no_more(needed[2].key)
    memory.until_it_waits(memory.ledger.coming_bytes + SMALL)
    assert needed[2].name in memory.ledger.retired, "something has changed"
    for one in mapped:
        one.close()


def test_a_walk_over_all_while_segments_go(memory: Memory) -> None:
    """What is there all the time is found, whatever goes meanwhile; larger ones first."""
    some: list[Any] = [*memory.publish(20), *memory.publish(20, LARGE)]
    segments, seen = memory.ledger.segments, list[Resident]()
    for resident in segments.walk():
        seen.append(resident)
        for gone in [one for one in some if one not in seen][:1]:
            segments.remove(gone)
            some.remove(gone)
    assert set(some) <= set(seen)
    assert [one.nbytes for one in seen] == sorted((one.nbytes for one in seen), reverse=True)
    for resident in some:
        segments.remove(resident)
    for resident in [*memory.ledger.residents()]:
        segments.add(resident)  # as it was


def test_what_the_kernel_reports_is_looked_at_less_and_less(memory: Memory) -> None:
    """Where it reports nothing, always after the same time."""
    (one,) = memory.publish(1)
    mapped, now_s = memory.map(one), NOW_S

    def waits() -> list[float]:
        """How long it is left alone each time."""
        nonlocal now_s
        found = []
        for _ in range(8):
            assert sum(memory.until_it_waits(SMALL, now_s)) == 1
            assert memory.evictor.free(SMALL, now_s) is Freeing.NO_MORE
            found.append(round(memory.ledger.evictable.next_look_s() - now_s, 3))
            now_s = memory.ledger.evictable.next_look_s()
        return found

    longer = [0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0, 5.0]
    assert waits() == longer
    other = memory.map(one)
    other.close()
    assert memory.reclaimer.on_closes(now_s)
    assert waits() == longer, "the kernel reported a close"
    memory.pins.watch_next_close = lambda name: False  # type: ignore[method-assign]  # noqa: ARG005
    assert waits() == [0.2] * 8
    mapped.close()
    memory.until_it_waits(SMALL, now_s)
    assert one.name in memory.ledger.retired


# --- which go first -------------------------------------------------------------------------------


def evicted(memory: Memory, count: int, now_s: float) -> list[Resident]:
    """Evict this many, and return them in order."""
    found = []
    for _ in range(count):
        memory.until_it_waits(memory.ledger.coming_bytes + SMALL, now_s)
        found.append([*memory.ledger.retired.values()][-1].resident)
    return found


def test_clients_decide_soon_after_they_have_moved(memory: Memory) -> None:
    """A plan is made at most each second, and none once there was memory for long."""
    some = memory.publish(30)
    for number, resident in enumerate(some):
        memory.move(resident, 100.0 * number)
    sessions, evictor = memory.reclaimer.sessions, memory.evictor
    session = sessions.open(connections.of(), "car", NOW_S)

    def drive_to(x: float) -> None:
        session.state_intent(Intent(x, 10.0))
        assert sessions.follow_moves() == [session]

    drive_to(0.0)
    assert evictor.next_s == float("inf"), "memory was never short"
    assert evicted(memory, 3, NOW_S) == some[:-4:-1]
    assert evictor.next_s == float("inf"), "nothing has changed"
    drive_to(2900.0)
    assert evictor.next_s == NOW_S + PLAN_S
    assert evicted(memory, 1, NOW_S) == [some[-4]], "so much is decided"
    evictor.run_step(NOW_S + PLAN_S)
    assert evictor.next_s == float("inf")
    assert evicted(memory, 3, NOW_S + PLAN_S) == some[:3]
    drive_to(0.0)
    later_s = NOW_S + PLAN_S + PRESSURE_S
    assert evictor.next_s < later_s
    evictor.run_step(later_s)
    drive_to(1200.0)
    assert evictor.next_s == float("inf"), "there was enough memory for long"
    evictor.free(memory.ledger.coming_bytes + SMALL, later_s + PRESSURE_S)
    assert [*memory.ledger.retired.values()][-1].resident is some[-5], "an old plan is replaced before"


def test_of_many_the_first_go_when_all_have_been_looked_at(memory: Memory) -> None:
    """In several calls, or steps while no load waits; what comes meanwhile goes when nothing else is left."""
    per_step = -(-WORK_PER_STEP // (BLOCK * (LOOK_WORK + LIST_WORK))) * BLOCK
    some = memory.publish(2 * per_step + 5)  # in one square
    random.Random(3).shuffle(some)
    for number, resident in enumerate(some):
        resident.last_use_s = number / 1e3
    evictor = memory.evictor
    for _ in range(2):
        assert evictor.free(SMALL, NOW_S) is Freeing.LATER
        assert evictor.wake_s == NOW_S
        assert not memory.ledger.retired, "not all have been looked at"
    spare = memory.publish(1)[0]
    assert evicted(memory, 20, NOW_S) == some[:20]
    assert evictor.next_s == NOW_S + PLAN_S, "there is another segment"
    at_s, steps = NOW_S, 0
    while evictor.next_s < float("inf"):
        at_s, steps = evictor.next_s, steps + 1
        evictor.run_step(at_s)
    assert steps == 2
    assert at_s == pytest.approx(
        NOW_S + PLAN_S + WORK_S * (2 * SQUARE_WORK + per_step * (LOOK_WORK + LIST_WORK))
    )
    assert evicted(memory, 1, at_s) == [spare]
    last = memory.publish(1)[0]
    rest = len(some) - 20
    assert evicted(memory, rest, at_s) == some[20:]
    assert evicted(memory, 1, at_s) == [last]
    assert evictor.free(memory.ledger.coming_bytes + 1, at_s) is Freeing.NO_MORE


def test_another_plan_is_made_when_all_that_was_listed_has_been_used_or_gone(
    memory: Memory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only some were listed: those that were used since, or wait for the end of their grace, come last."""
    monkeypatch.setattr(eviction_plan, "MAX_LISTED", 4)
    some = memory.publish(10)
    for number, resident in enumerate(some):
        resident.last_use_s = number / 1e3
    assert evicted(memory, 1, NOW_S) == some[:1]
    some[1].last_use_s = NOW_S - 2.0
    some[2].last_use_s = NOW_S
    assert evicted(memory, 7, NOW_S) == [some[3], *some[4:]][:7]
    assert evicted(memory, 1, NOW_S) == [some[1]]
    memory.until_it_waits(memory.ledger.coming_bytes + SMALL, NOW_S)
    assert memory.evictor.wake_s == NOW_S + HAND_OUT_GRACE_S


def test_while_all_are_in_their_grace_no_other_plan_is_made(
    memory: Memory, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(eviction_plan, "MAX_LISTED", 4)
    for number, resident in enumerate(memory.publish(10)):
        resident.last_use_s = NOW_S - 0.5 + number / 1e3
    memory.until_it_waits(SMALL, NOW_S)
    assert memory.evictor.wake_s == NOW_S + 0.5
    assert evicted(memory, 1, NOW_S + 0.5)[0].last_use_s == NOW_S - 0.5


def test_the_first_plan_is_made_before_memory_is_short(memory: Memory) -> None:
    memory.publish(7)
    ledger, evictor = memory.ledger, memory.evictor
    ledger.budget_bytes = 8 * SMALL
    assert evictor.next_s == float("inf")
    memory.publish(1)
    assert evictor.next_s <= NOW_S
    evictor.run_step(NOW_S)
    assert evictor.next_s == float("inf")


@pytest.mark.parametrize("count", [10_000, 20_000, pytest.param(100_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("clients", "vertices"), [(1, 0), (8, 0), (1, 200)], ids=["1", "8", "128"])
def test_plans_take_a_fortieth_of_a_core_at_most(
    memory: Memory, monkeypatch: pytest.MonkeyPatch, count: int, clients: int, vertices: int
) -> None:
    """A unit of work takes 20 ns.  With 1, 8 and about 128 places, while clients move."""
    ledger, sessions, evictor = memory.ledger, memory.reclaimer.sessions, memory.evictor
    work, steps, now_s, next_pose_s = 0, list[int](), NOW_S, NOW_S
    for number in range(count):
        x, y = 20.0 * (number % 320), 20.0 * (number // 320)
        box, nbytes = (x, y, x + 20.0, y + 20.0), SMALL * (1 + number % 5)
        ledger.enter(Resident(f"{number}", Key(f"{number}", ""), number, nbytes, 1, box, 0.0, 1.0))
    squares, learn, until_needed = ledger.evictable.squares, Square.learn, places.until_needed

    def counted_squares() -> Iterator[Square]:
        nonlocal work
        for square in squares():
            work += SQUARE_WORK
            yield square

    def counted_learn(square: Square, some: Sequence[Resident]) -> None:
        nonlocal work
        work += LOOK_WORK * len(some)
        learn(square, some)

    def counted_until_needed(boxes: Any, where: Any, now_s: float) -> Any:
        nonlocal work
        work += len(boxes) * len(where)
        return until_needed(boxes, where, now_s)

    monkeypatch.setattr(ledger.evictable, "squares", counted_squares)
    monkeypatch.setattr(Square, "learn", counted_learn)
    monkeypatch.setattr(places, "until_needed", counted_until_needed)
    monkeypatch.setattr(eviction_plan, "until_needed", counted_until_needed)
    who = [sessions.open(connections.of(), "car", NOW_S) for _ in range(clients)]
    ledger.budget_bytes = ledger.used_bytes
    while now_s < NOW_S + 4.0:
        if now_s >= next_pose_s:
            next_pose_s += 0.1
            for number, session in enumerate(who):
                x, y = 12.0 * (now_s - NOW_S), 500.0 * number
                route = tuple((x + 20.0 * n, y) for n in range(vertices))
                connections.says(session, Intent(x, y, 12.0, 0.0, None, route), now_s)
            while sessions.moved:
                sessions.follow_moves()
        if evictor.next_s <= now_s:
            before = work
            evictor.run_step(now_s)
            steps.append(work - before)
        now_s = min(max(evictor.next_s, now_s + 1e-6), next_pose_s)
    assert max(steps) <= 3 * WORK_PER_STEP
    assert LOOK_WORK * 3 * MAX_LISTED <= work <= 4.0 / WORK_S + max(steps)
    found = len(sessions.places())
    assert found == clients if not vertices else 100 < found <= 128
    for one in [*ledger.segments.walk()]:
        ledger.segments.remove(one)  # they have no files


def test_while_clients_stand_no_other_plan_is_made(memory: Memory) -> None:
    """Although they send where they are."""
    memory.publish(3)
    sessions, evictor = memory.reclaimer.sessions, memory.evictor
    session = sessions.open(connections.of(), "car", NOW_S)

    def is_planned_after(x: float, now_s: float) -> bool:
        connections.says(session, Intent(x, 10.0), now_s)
        sessions.follow_moves()
        return evictor.next_s < float("inf")

    is_planned_after(5.0, NOW_S)
    evicted(memory, 1, NOW_S)
    assert not any(is_planned_after(5.0, NOW_S + second) for second in range(1, 5))
    assert is_planned_after(6.0, NOW_S + 5.0)


def test_a_wish_takes_only_what_is_needed_later(memory: Memory) -> None:
    some = memory.publish(3)
    for number, resident in enumerate(some):
        resident.last_use_s = 10.0 * number
    wish = Resident("", Key("wish", "points"), 9, SMALL, 0, (0.0, 0.0, 1.0, 1.0), 0.0, 0.0, last_use_s=15.0)

    def free() -> Freeing:
        return memory.evictor.free(memory.ledger.coming_bytes + SMALL, NOW_S, rather_than=wish)

    assert free() is Freeing.LATER, "first a plan is made"
    assert [free(), free(), free()] == [Freeing.ENOUGH, Freeing.ENOUGH, Freeing.NO_MORE]
    assert [one.resident for one in memory.ledger.retired.values()] == some[:2]


def test_a_full_share_gives_up_what_is_needed_later_whatever_its_size(memory: Memory) -> None:
    (near,), far = memory.publish(1, LARGE, prefetched=True), memory.publish(6, prefetched=True)
    for x, resident in zip((200.0, *range(600, 1200, 100)), (near, *far), strict=True):
        memory.move(resident, x)
    session = memory.reclaimer.sessions.open(connections.of(), "car", NOW_S)
    session.state_intent(Intent(0.0, 10.0, vx=10.0))
    memory.reclaimer.sessions.follow_moves()
    wish = Resident("", Key("wish", "points"), 99, SMALL, 0, (400.0, 0.0, 420.0, 20.0), 0.0, 0.0)
    assert memory.evictor.give_up_prefetched(2 * SMALL, NOW_S, wish)
    assert [one.resident for one in memory.ledger.retired.values()] == far[:-3:-1], "needed last"
    assert memory.evictor.give_up_prefetched(99 * SMALL, NOW_S, wish)
    assert list(memory.ledger.prefetched) == [near]
    assert not memory.evictor.give_up_prefetched(SMALL, NOW_S, wish)

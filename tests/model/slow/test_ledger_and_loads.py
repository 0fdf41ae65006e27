# SPDX-License-Identifier: Apache-2.0
"""The ledger, the loads and the reclaimer against a plain model, with real segments and real mappings.

The machine plays daemon, loaders and readers in any order: it wants, starts, grows, publishes, fails,
takes back and cancels loads, hands segments out, maps and unmaps them, evicts, revives, changes
versions and lets time pass on a clock of its own.  Segments are files on /dev/shm and pins are the
kernel's word on mappings of them.
"""

from __future__ import annotations

import math
import mmap
import os
import select
import shutil
import tempfile
from dataclasses import dataclass, field

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from shmmap.daemon.cache.eviction_plan import HAND_OUT_GRACE_S
from shmmap.daemon.cache.evictor import Evictor, Freeing
from shmmap.daemon.cache.ledger import Ledger
from shmmap.daemon.cache.reclaimer import Reclaimer
from shmmap.daemon.loading.loads import Attempt, Load, Loads
from shmmap.daemon.pins.watch import PinWatch
from shmmap.daemon.records import Failure, Key, Resident
from shmmap.daemon.transport.sessions import Session, Sessions
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.pins import lock_slot, prepare_process
from tests.support import connections

PAGE = 4096
KEYS = [Key(f"/map/{number}.pcd", "points") for number in range(4)]
BUDGET_PAGES = 16
OVERHEAD_PAGES = 2


@dataclass
class Segment:
    """What the model knows of one published file; ``maps`` are the mappings of it that live."""

    name: str
    key: Key
    version: int
    pages: int
    state: str = "resident"
    last_use_s: float = 0.0
    maps: list[mmap.mmap] = field(default_factory=list)


@dataclass
class Wanted:
    """What the model knows of one load."""

    load: Load
    priority: float
    order: int
    running: bool = False
    reserved: int = 0


@settings(
    max_examples=300,
    stateful_step_count=50,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
class Machine(RuleBasedStateMachine):
    """One run of ledger and loads; it observes what the reclaimer retires and frees."""

    @initialize(elsewhere=st.booleans())
    def begin(self, elsewhere: bool) -> None:
        """With ``elsewhere`` all memory is freed in the other thread, not only of large segments."""
        prepare_process()
        self.path = tempfile.mkdtemp(prefix="shmmap-model-", dir="/dev/shm")
        self.directory = ShmDirectory(self.path)
        self.ledger = Ledger(BUDGET_PAGES * PAGE)
        self.queue = Loads(self.ledger)
        self.ledger.overhead_bytes = OVERHEAD_PAGES * PAGE
        self.sessions = Sessions()
        self.clients = [self.sessions.open(connections.of(), f"client {n}", 0.0) for n in range(2)]
        self.reclaimer = Reclaimer(self.ledger, self.directory, self.sessions, PinWatch(self.directory), self)
        if elsewhere:
            self.reclaimer.closer.small_bytes = 0
        self.evictor = Evictor(self.reclaimer)
        self.names_retired: list[str] = []
        self.now_s = 100.0
        self.versions = dict.fromkeys(KEYS, 1)
        self.segments: dict[str, Segment] = {}
        self.loads: dict[Key, Wanted] = {}
        self.failures: dict[Key, str] = {}
        self.waiting = dict.fromkeys(KEYS, 0)
        self.names = 0
        self.orders = 0
        self.objects: dict[str, Resident] = {}

    def segment_retired(self, resident: Resident, _why: str) -> None:
        self.names_retired.append(resident.name)

    # --- what the model derives ---------------------------------------------------------------------

    def of_state(self, state: str) -> list[Segment]:
        return [segment for segment in self.segments.values() if segment.state == state]

    def resident_of(self, key: Key) -> Segment | None:
        found = [s for s in self.of_state("resident") if s.key == key]
        assert len(found) <= 1
        return found[0] if found else None

    def follow(self) -> None:
        """Take over what the reclaimer retired and freed; nothing mapped may be among the freed."""
        for name in self.names_retired:
            assert self.segments[name].state == "resident"
            self.segments[name].state = "zombie"
        self.names_retired.clear()
        for segment in self.of_state("zombie"):
            if segment.name not in self.ledger.retired:
                assert not segment.maps, "a mapped segment was freed"
                del self.segments[segment.name]

    # --- loads --------------------------------------------------------------------------------------

    @rule(
        key=st.sampled_from(KEYS),
        pages=st.integers(1, 6),
        priority=st.one_of(st.sampled_from([0.0, 5.0, float("inf")]), st.floats(0, 100)),
    )
    def want(self, key: Key, pages: int, priority: float) -> None:
        load = self.queue.want(key, pages * PAGE, priority)
        known = self.loads.get(key)
        if known is None:
            self.orders += 1
            self.loads[key] = Wanted(load, priority, self.orders)
        else:
            assert load is known.load, "two loads of one key"
            if not known.running:
                known.priority = min(known.priority, priority)

    @rule()
    def start_next(self) -> None:
        queued = [w for w in self.loads.values() if not w.running]
        load = self.queue.queue.choose()
        if not queued:
            assert load is None
            return
        nearest = min(queued, key=lambda w: (w.priority, w.order))
        assert load is nearest.load
        used = sum(s.pages for s in self.segments.values()) + OVERHEAD_PAGES
        used += (sum(w.reserved for w in self.loads.values()) + self.ledger.freeing_bytes) // PAGE
        shortage = used + load.estimate // PAGE - BUDGET_PAGES
        assert self.ledger.shortage(load.estimate) == shortage * PAGE
        if shortage > 0:
            assert not self.queue.start(load, Attempt(self.now_s)), "a load started that does not fit"
            return
        assert self.queue.start(load, Attempt(self.now_s))
        nearest.running, nearest.reserved = True, load.estimate

    def running(self, draw: int) -> Wanted | None:
        found = [w for w in self.loads.values() if w.running]
        return found[draw % len(found)] if found else None

    @rule(draw=st.integers(0, 100), pages=st.integers(1, 10))
    def grow(self, draw: int, pages: int) -> None:
        wanted = self.running(draw)
        if wanted is not None:
            used = self.ledger.used_bytes
            extra = pages * PAGE - wanted.reserved
            fits = extra <= 0 or used + extra <= BUDGET_PAGES * PAGE
            assert self.queue.grow(wanted.load, pages * PAGE) is fits
            if fits:
                wanted.reserved = max(wanted.reserved, pages * PAGE)

    @rule(draw=st.integers(0, 100), less=st.integers(0, 3))
    def publish(self, draw: int, less: int) -> None:
        """A loader is done, with no more bytes than are reserved."""
        wanted = self.running(draw)
        if wanted is not None:
            self.published(wanted, max(1, wanted.reserved // PAGE - less))

    def published(self, wanted: Wanted, pages: int) -> Segment:
        key = wanted.load.key
        self.names += 1
        name = f"/shmmap.model.{self.names:016x}"
        fd = self.directory.create()
        os.posix_fallocate(fd, 0, pages * PAGE)
        self.directory.link(fd, name)
        os.close(fd)
        old = self.resident_of(key)
        resident = Resident(
            name, key, self.versions[key], pages * PAGE, 0, (float(self.names), 0, 1, 1), 0, 0
        )
        resident.last_use_s = self.now_s
        superseded = self.ledger.enter(resident)
        self.queue.finish(wanted.load)
        assert (superseded.name if superseded else None) == (old.name if old else None)
        self.segments[name] = Segment(name, key, self.versions[key], pages, last_use_s=self.now_s)
        self.objects[name] = resident
        del self.loads[key]
        self.failures.pop(key, None)
        if superseded is not None:
            self.reclaimer.superseded(superseded, self.now_s)
            self.follow()
            assert superseded.name not in self.segments or self.segments[superseded.name].state == "zombie"
        return self.segments[name]

    @rule(key=st.sampled_from(KEYS), pages=st.integers(1, 5), maps=st.integers(0, 2))
    def load_at_once(self, key: Key, pages: int, maps: int) -> None:
        """All of it in one step, where it fits, up to readers that map it."""
        if key not in self.loads and self.ledger.shortage(pages * PAGE) <= 0:
            self.want(key, pages, -1.0)
            self.start_next()
            segment = self.published(self.loads[key], pages)
            for _ in range(maps):
                self.map_it(segment, -1)

    @rule(draw=st.integers(0, 100), code=st.sampled_from(["load_failed", "over_budget"]))
    def fail(self, draw: int, code: str) -> None:
        wanted = self.running(draw)
        if wanted is not None:
            self.queue.finish(wanted.load, Failure(code, "", None, self.now_s + 1, 1))
            del self.loads[wanted.load.key]
            self.failures[wanted.load.key] = code

    @rule(draw=st.integers(0, 100))
    def give_back(self, draw: int) -> None:
        """Its loader died before its turn."""
        wanted = self.running(draw)
        if wanted is not None:
            self.queue.requeue(wanted.load)
            wanted.running, wanted.reserved = False, 0

    @rule(key=st.sampled_from(KEYS))
    def cancel(self, key: Key) -> None:
        self.queue.cancel(key)
        self.failures.pop(key, None)
        if key in self.loads and not self.loads[key].running:
            del self.loads[key]

    @rule()
    def memory_came_back(self) -> None:
        self.queue.forget_refusals()
        self.failures = {key: code for key, code in self.failures.items() if code != "over_budget"}

    @rule(key=st.sampled_from(KEYS), more=st.booleans())
    def wait(self, key: Key, more: bool) -> None:
        if more:
            self.ledger.need(key)
            self.waiting[key] += 1
        elif self.waiting[key]:
            self.ledger.need_no_more(key)
            self.waiting[key] -= 1

    # --- readers ------------------------------------------------------------------------------------

    def any_segment(self, draw: int, state: str) -> Segment | None:
        found = self.of_state(state)
        return found[draw % len(found)] if found else None

    @rule(draw=st.integers(0, 100), client=st.integers(0, 1))
    def hand_out(self, draw: int, client: int) -> None:
        segment = self.any_segment(draw, "resident")
        if segment is not None:
            resident = self.objects[segment.name]
            resident.last_use_s = segment.last_use_s = self.now_s
            self.clients[client].hold([resident])

    @rule(draw=st.integers(0, 100), client=st.integers(-1, 1))
    def map(self, draw: int, client: int) -> None:
        """A reader maps a segment, with its session's lock or (-1) without."""
        segment = self.any_segment(draw, "resident")
        if segment is not None:
            self.map_it(segment, client)

    def map_it(self, segment: Segment, client: int) -> None:
        fd = self.directory.open(segment.name)
        if client >= 0:
            lock_slot(fd, self.clients[client].slot)
        segment.maps.append(mmap.mmap(fd, segment.pages * PAGE, prot=mmap.PROT_READ))
        os.close(fd)

    @rule(draw=st.integers(0, 100), says=st.booleans())
    def unmap(self, draw: int, says: bool) -> None:
        """A reader unmaps a segment, and says so or does not."""
        mapped = [segment for segment in self.segments.values() if segment.maps]
        if mapped:
            segment = mapped[draw % len(mapped)]
            segment.maps.pop().close()
            if says:
                self.release([self.objects[segment.name]])

    @rule(client=st.integers(0, 1), draw=st.integers(0, 100))
    def drop(self, client: int, draw: int) -> None:
        """A session says it has a version no more (whether it still maps it or not)."""
        session = self.clients[client]
        versions = list(session.held)
        if versions:
            self.release(session.drop([versions[draw % len(versions)], 12345]))

    def release(self, residents: list[Resident]) -> None:
        self.reclaimer.release(residents, self.now_s)
        self.follow()

    # --- memory -------------------------------------------------------------------------------------

    @rule(key=st.sampled_from(KEYS), back=st.booleans())
    def change_version(self, key: Key, back: bool) -> None:
        self.versions[key] = max(1, self.versions[key] - 1) if back else self.versions[key] + 1

    @rule(draw=st.integers(0, 100))
    def evict(self, draw: int) -> None:
        segment = self.any_segment(draw, "resident")
        if segment is not None:
            unmapped = self.reclaimer.retire(self.objects[segment.name], self.now_s)
            assert unmapped is not bool(segment.maps)
            self.follow()
            assert segment.state == "zombie"

    @rule(draw=st.integers(0, 100), go_back=st.booleans())
    def revive(self, draw: int, go_back: bool) -> None:
        """Only a segment of exactly this version comes back, with its bytes and its name."""
        retired = self.any_segment(draw, "zombie")
        key = retired.key if retired is not None else KEYS[draw % len(KEYS)]
        if retired is not None and go_back:
            self.versions[key] = retired.version
        before = self.resident_of(key)
        found = self.reclaimer.revive(key, self.versions[key], self.now_s)
        if found is not None:
            segment = self.segments[found.name]
            assert (segment.state, segment.key, segment.version) == ("zombie", key, self.versions[key])
            segment.state = "resident"
            if before is not None:
                assert before.name in self.names_retired
        self.follow()

    @rule(seconds=st.sampled_from([0.0, 0.001, 0.01, 0.3, 2.0]))
    def tick(self, seconds: float) -> None:
        self.now_s += seconds
        before = self.ledger.retired_bytes
        freed = self.reclaimer.sweep(self.now_s)
        assert freed == before - self.ledger.retired_bytes
        before = self.ledger.retired_bytes
        assert self.reclaimer.collect() == before - self.ledger.retired_bytes
        self.follow()

    @rule()
    def wait_for_the_other_thread(self) -> None:
        """What it frees counts as used until it has."""
        while self.ledger.freeing_bytes:
            select.select([self.reclaimer.closer.fd], [], [], 10.0)
            before = self.ledger.used_bytes
            freed = self.reclaimer.collect()
            # what is counted already is reported in vain
            assert freed == before - self.ledger.used_bytes >= 0

    @rule(pages=st.integers(1, BUDGET_PAGES))
    def make_room(self, pages: int) -> None:
        """Asked often enough it comes to an end, and to the right one."""
        self.now_s += 0.25  # older looks at pins are forgotten
        self.reclaimer.sweep(self.now_s)  # as the scheduler does before
        self.follow()
        mapped = sum(s.pages for s in self.segments.values() if s.maps)
        needed = sum(s.pages for s in self.of_state("resident") if not s.maps and self.waiting[s.key])
        reserved = sum(w.reserved for w in self.loads.values()) // PAGE
        room = BUDGET_PAGES - OVERHEAD_PAGES - reserved - mapped - needed
        for _ in range(64):
            shortage = self.ledger.shortage(pages * PAGE)
            if shortage <= 0:
                assert pages <= room
                return
            freeing = self.evictor.free(shortage, self.now_s)
            self.follow()
            if freeing is Freeing.NO_MORE:
                assert pages > room
                return
            self.wait_for_the_other_thread()
            due_s = min(self.evictor.wake_s, self.reclaimer.next_sweep_s())
            self.now_s = max(self.now_s + 1e-6, due_s if due_s < math.inf else 0.0)
            self.reclaimer.sweep(self.now_s)
            self.follow()
        raise AssertionError("no end to making room")

    @rule()
    def just_handed_out_is_safe(self) -> None:
        """A client that got a handle a moment ago can still open it, unless it was evicted on purpose."""
        for segment in self.of_state("resident"):
            if segment.last_use_s + HAND_OUT_GRACE_S > self.now_s:
                self.evictor.free(BUDGET_PAGES * PAGE, self.now_s)
                self.follow()
                assert segment.state == "resident"
                assert os.path.exists(self.path + segment.name)

    # --- always -------------------------------------------------------------------------------------

    @invariant()
    def bytes_are_in_one_place(self) -> None:
        ledger = self.ledger
        assert ledger.resident_bytes == sum(s.pages for s in self.of_state("resident")) * PAGE
        mapped_bytes = ledger.retired_bytes - ledger.freeing_bytes
        assert mapped_bytes == sum(s.pages for s in self.of_state("zombie")) * PAGE
        assert ledger.unopened_bytes == sum(
            retired.resident.nbytes for retired in ledger.retired.values() if retired.unopened
        )
        everything = [*ledger.residents(), *(retired.resident for retired in ledger.retired.values())]
        assert len(ledger.segments) == len(everything)
        assert set(ledger.segments.walk()) == set(everything)
        assert all(ledger.resident_named(one.name) is one for one in ledger.evictable.new)
        assert ledger.reserved_bytes == sum(w.reserved for w in self.loads.values())
        parts = ledger.resident_bytes + ledger.retired_bytes + ledger.reserved_bytes + ledger.overhead_bytes
        assert ledger.used_bytes == parts <= ledger.budget_bytes
        assert ledger.resident_count == len(self.of_state("resident"))
        assert {r.name for r in ledger.residents()} == {s.name for s in self.of_state("resident")}
        assert set(ledger.retired) == {s.name for s in self.of_state("zombie")}

    @invariant()
    def the_disk_agrees(self) -> None:
        expected = {s.name + (".zombie" if s.state == "zombie" else "") for s in self.segments.values()}
        found = {"/" + entry.name: entry.stat().st_blocks * 512 for entry in os.scandir(self.path)}
        assert set(found) == expected
        named_bytes = self.ledger.resident_bytes + self.ledger.retired_bytes - self.ledger.freeing_bytes
        assert sum(found.values()) == named_bytes

    @invariant()
    def they_say_what_the_model_says(self) -> None:
        assert len(self.queue) == sum(not w.running for w in self.loads.values())
        assert self.queue.by_key == {key: wanted.load for key, wanted in self.loads.items()}
        assert {key: failure.code for key, failure in self.queue.failures.items()} == self.failures
        named = {key: resident.name for key, resident in self.ledger.by_key.items()}
        assert named == {s.key: s.name for s in self.of_state("resident")}
        assert self.ledger._needed == {key: count for key, count in self.waiting.items() if count}

    @invariant()
    def sessions_hold_what_exists(self) -> None:
        for session in self.clients:
            held = [resident for known in session.held.values() for resident in known]
            assert session.held_bytes == sum(resident.nbytes for resident in held)
            for resident in held:
                assert resident.name in self.segments
                assert session.slot in resident.sessions
        for segment in self.segments.values():
            for slot in self.objects[segment.name].sessions:
                holder = self.sessions.slots.get(slot)
                assert isinstance(holder, Session)
                resident = self.objects[segment.name]
                assert resident in holder.held[resident.version]

    def teardown(self) -> None:
        """Once nothing is mapped or waited for, all memory can be had back."""
        if not hasattr(self, "path"):
            return
        for segment in self.segments.values():
            while segment.maps:
                segment.maps.pop().close()
        for key, count in self.waiting.items():
            for _ in range(count):
                self.ledger.need_no_more(key)
        for wanted in self.loads.values():
            self.queue.finish(wanted.load)
        for _ in range(8):
            self.now_s += 2.0
            self.evictor.free(BUDGET_PAGES * PAGE, self.now_s)
            self.reclaimer.sweep(self.now_s)
            self.wait_for_the_other_thread()
        self.follow()
        self.reclaimer.close()
        left, used = os.listdir(self.path), self.ledger.used_bytes
        for session in self.clients:
            self.sessions.close(session)
        self.directory.close()
        shutil.rmtree(self.path)
        assert left == []
        assert used == OVERHEAD_PAGES * PAGE
        assert not self.segments


TestLedgerAndLoads = Machine.TestCase

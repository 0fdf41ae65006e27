# SPDX-License-Identifier: Apache-2.0
"""A paged map equals an unbounded one: every chunk takes in every scan once and in order, whatever happens.

The machine plays mappers, clients, worker and disk in any order: scans come, clients move, jump and leave,
files are read and written and cannot be, chunks grow while others wait, lists take room beside them.
A chunk's voxels are stood for by the list of scans that it took in.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import product

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from shmmap.chunks.voxels import ChunkKey
from shmmap.live_worker.paging.durability import Chunk, Scan, State
from shmmap.live_worker.paging.key_index import EVERYWHERE
from shmmap.live_worker.paging.residency import RETRY_S, Limits, Residency

NEW = 10
MOST = 60
KEY = st.builds(ChunkKey, st.integers(-2, 2), st.just(0), st.just(0))
PLACE = st.floats(-2.5, 2.5, width=16)


@dataclass
class Content:
    """What a chunk holds: in memory, or in its file."""

    scans: list[int] = field(default_factory=list)
    nbytes: int = NEW

    @property
    def version(self) -> int:
        return len(self.scans)

    def copy(self) -> Content:
        return replace(self, scans=list(self.scans))


class LiveMap(RuleBasedStateMachine):
    """One map, its worker's memory and its disk."""

    def __init__(self) -> None:
        super().__init__()
        self.now_s = 0.0
        self.reference: dict[ChunkKey, list[int]] = {}
        self.memory: dict[ChunkKey, Content] = {}
        self.disk: dict[ChunkKey, Content] = {}
        self.safe: dict[ChunkKey, Content] = {}  # what a power cut leaves
        self.loads: list[Chunk] = []
        self.saves: list[tuple[Chunk, Content]] = []
        self.scans: list[Scan] = []
        self.flushing: dict[ChunkKey, Content] | None = None
        self.durable: list[Scan] = []
        self.sent = 0

    @initialize(
        chunks=st.integers(2, 4), reserve=st.booleans(), active=st.sampled_from([0, 6]),
        radius=st.integers(0, 1), waiting=st.sampled_from([1, 1000]), most=st.sampled_from([0, 0, 2, 5]),
    )  # fmt: skip
    def begin(self, chunks: int, *, reserve: bool, active: int, radius: int, waiting: int, most: int) -> None:
        budget = chunks * MOST
        self.limits = Limits(
            budget_bytes=budget, reserve_bytes=budget * 3 // 4 if reserve else 0, max_chunks=most,
            most_active=active, radius=radius, waiting_bytes=waiting, loads=2, saves=2, checkpoint_s=5.0,
        )  # fmt: skip
        self.map = Residency(self.limits, new_bytes=NEW)

    # --- what comes ---------------------------------------------------------------------------

    @rule(keys=st.sets(KEY, min_size=1, max_size=4))
    def scan(self, keys: set[ChunkKey]) -> None:
        if not self.map.has_room(3):
            assert self.map.waiting_bytes > 0
            return
        self.sent += 1
        scan = Scan(1, self.sent, 3, set(keys))
        for key in keys:
            self.reference.setdefault(key, []).append(scan.number)
        self._send(scan)

    def _send(self, scan: Scan) -> None:
        self.scans.append(scan)
        self.map.add(scan)

    @precondition(lambda self: self.sent)
    @rule(data=st.data())
    def send_again(self, data: st.DataObject) -> None:
        """The mapper had no answer; each chunk knows what it has taken in."""
        number = data.draw(st.integers(1, self.sent))
        if self.map.has_room(3):
            self._send(Scan(1, number, 3, {key for key, scans in self.reference.items() if number in scans}))

    @rule(client=st.integers(1, 2), x=PLACE, y=PLACE)
    def move(self, client: int, x: float, y: float) -> None:
        self.map.move(client, (x, y, 0.5))

    @rule(client=st.integers(1, 2))
    def leave(self, client: int) -> None:
        self.map.leave(client)

    @rule(seconds=st.sampled_from([0.01, 0.2, 1.0, 6.0]))
    def wait(self, seconds: float) -> None:
        self.now_s += seconds

    # --- what the worker does -----------------------------------------------------------------

    @rule()
    def begin_load(self) -> None:
        chunk = self.map.begin_load(self.now_s)
        if chunk is not None:
            assert chunk.key not in self.memory
            self.loads.append(chunk)

    @precondition(lambda self: self.loads)
    @rule(data=st.data(), fails=st.booleans())
    def end_load(self, data: st.DataObject, *, fails: bool) -> None:
        self._end_load(self.loads.pop(data.draw(st.integers(0, len(self.loads) - 1))), fails=fails)

    def _end_load(self, chunk: Chunk, *, fails: bool) -> None:
        if fails:
            self.map.load_failed(chunk, self.now_s)
            return
        content = self.disk.get(chunk.key, Content()).copy()
        self.memory[chunk.key] = content
        self.map.loaded(chunk, version=content.version, nbytes=content.nbytes, active=content.version % 4)

    @rule(most=st.integers(1, 5), grows=st.integers(0, MOST - NEW))
    def apply(self, most: int, grows: int) -> None:
        for chunk, scan in self.map.ready()[:most]:
            content = self.memory[chunk.key]
            more = min(grows, MOST - content.nbytes)
            if more and not self.map.may_grow(chunk, more):
                continue
            if scan.number not in content.scans:
                content.scans.append(scan.number)
                content.nbytes += more
            self.map.applied(
                chunk, scan, version=content.version, nbytes=content.nbytes, active=content.version % 4,
                now_s=self.now_s,
            )  # fmt: skip

    @rule(everything=st.booleans())
    def begin_save(self, *, everything: bool) -> None:
        chunk = self.map.begin_save(self.now_s, everything=everything)
        if chunk is not None:
            assert chunk.key not in [other.key for other, _ in self.saves], "one save of a chunk at a time"
            self.saves.append((chunk, self.memory[chunk.key].copy()))

    @precondition(lambda self: self.saves)
    @rule(data=st.data(), fails=st.booleans())
    def end_save(self, data: st.DataObject, *, fails: bool) -> None:
        self._end_save(*self.saves.pop(data.draw(st.integers(0, len(self.saves) - 1))), fails=fails)

    def _end_save(self, chunk: Chunk, content: Content, *, fails: bool) -> None:
        if fails:
            self.map.save_failed(chunk, self.now_s)
        else:
            self.disk[chunk.key] = content
            self.map.saved(chunk, content.version, self.now_s)

    @rule(everything=st.booleans())
    def flush(self, *, everything: bool = True) -> None:
        if self.map.flush_is_due(self.now_s, everything=everything):
            self.map.durability.begin()
            self.flushing = {key: content.copy() for key, content in self.disk.items()}

    @precondition(lambda self: self.flushing is not None)
    @rule(fails=st.booleans())
    def end_flush(self, *, fails: bool) -> None:
        """Names that are as they were when it began are safe; or none more than before."""
        flushing, self.flushing = self.flushing, None
        if fails or flushing is None:
            self.map.durability.failed(self.now_s)
        else:
            self.safe = flushing
            self.durable += self.map.durability.flushed()

    @rule()
    def evict(self) -> None:
        chunk = self.map.evict_next(self.now_s)
        if chunk is not None:
            content = self.memory.pop(chunk.key)
            assert content.scans == self.disk.get(chunk.key, Content()).scans, (
                "nothing is given up that is not saved"
            )

    @rule(asked=st.integers(1, MOST))
    def take_beside(self, asked: int) -> None:
        """A list of voxels takes memory, of the part that lists may, when there is room."""
        self.map.asked_bytes = 0
        if self.map.beside_bytes + asked <= self.limits.budget_bytes // 4:
            if self.map.fits(asked):
                self.map.beside_bytes += asked
            else:
                self.map.asked_bytes = asked

    @rule()
    def release_beside(self) -> None:
        self.map.beside_bytes = self.map.asked_bytes = 0

    # --- what always holds --------------------------------------------------------------------

    @invariant()
    def the_books_are_right(self) -> None:
        if not hasattr(self, "map"):
            return
        sizes = {key: content.nbytes for key, content in self.memory.items()}
        loading = {chunk.key: chunk.nbytes for chunk in self.loads}
        assert self.map.chunk_bytes == sum(sizes.values()) + sum(loading.values())
        assert self.map.active == sum(content.version % 4 for content in self.memory.values())
        assert self.map.chunk_bytes + self.map.beside_bytes <= self.limits.budget_bytes
        assert list(self.map.index.part(None, EVERYWHERE, 10**9)[0]) == sorted(self.map.chunks)
        held = len(sizes) + len(loading)
        assert not self.limits.max_chunks or held <= self.limits.max_chunks
        around = [center for one in (1, 2) if (center := self.map.windows.center(one)) is not None]
        assert set(self.map.windows.near) == {
            ChunkKey(*key)
            for center in around
            for key in product(
                *(range(at - self.limits.radius, at + self.limits.radius + 1) for at in center)
            )
        }
        for key in self.map.windows.near:
            assert key in self.map.chunks or key in self.map._missing
        waiting = [scan for scan in self.scans if not scan.applied]
        assert self.map.waiting_bytes == 3 * len(waiting)
        assert self.map.waiting_bytes <= max(3, self.limits.waiting_bytes)

    @invariant()
    def scans_are_taken_in_once_and_in_order(self) -> None:
        for key, content in [*self.memory.items(), *self.disk.items()]:
            assert content.scans == self.reference.get(key, [])[: content.version]

    @invariant()
    def what_is_durable_is_on_the_disk(self) -> None:
        for scan in self.scans:
            if scan.durable:
                for key, scans in self.reference.items():
                    assert scan.number not in scans or scan.number in self.safe[key].scans

    def teardown(self) -> None:
        """Left alone, with a disk that works and lists that are released, all comes to rest on the disk."""
        if not hasattr(self, "map"):
            return
        for _ in range(2000):
            at_rest = not self.loads and not self.saves and self.flushing is None
            if at_rest and all(scan.durable for scan in self.scans):
                break
            if not self.limits.reserve_bytes:  # else what is beside the chunks does not matter
                self.release_beside()
            self.begin_load()
            if self.loads:
                self._end_load(self.loads.pop(), fails=False)
            self.apply(100, 7)
            chunk = self.map.begin_save(self.now_s, everything=True)
            if chunk is not None:
                self.saves.append((chunk, self.memory[chunk.key].copy()))
            if self.saves:
                self._end_save(*self.saves.pop(), fails=False)
            self.flush()
            if self.flushing is not None:
                self.end_flush(fails=False)
            self.evict()
            self.now_s += RETRY_S / 10
            self.the_books_are_right()
        else:
            raise AssertionError("it never comes to rest")
        assert {key: content.scans for key, content in self.disk.items() if content.scans} == self.reference
        reported = {id(scan) for scan in self.durable}
        assert all(id(scan) in reported or scan.durable for scan in self.scans)
        assert len(reported) == len(self.durable), "each is reported once"
        for chunk in self.map.chunks.values():
            assert chunk.state in (State.CLEAN, State.LOADING)


LiveMap.TestCase.settings = settings(max_examples=200, stateful_step_count=100, deadline=None)
test_a_paged_map_equals_an_unbounded_one = LiveMap.TestCase

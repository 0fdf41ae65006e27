# SPDX-License-Identifier: Apache-2.0
"""What is in memory, what is being loaded, and whether more fits: the books, without any I/O.

Every byte is in exactly one place: *resident* (a named segment that can be handed out), *zombie* (a
retired one that somebody may still map), or *reserved* (promised to a load).  Their sum never
exceeds the budget: a load starts only when its reservation fits.

Times are seconds on any one clock, injected by the caller.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from shmmap.daemon.loading.load_queue import LoadQueue

__all__ = ["Failure", "Key", "Load", "Residency", "Resident", "Slot", "Zombie"]

MOST_FAILURES: Final = 1 << 14
"""Failures of a kind that are remembered: who asks for ever new layers must not fill the memory with them."""


class Key(NamedTuple):
    """One layer of one cell."""

    cell_id: str
    layer: str


@dataclass(slots=True, eq=False)
class Resident:
    """A published segment and what the daemon knows of its use.

    ``checked`` is false for one of an earlier life of the daemon until its bytes were compared with
    their checksums: until then nobody is handed it.
    """

    name: str
    key: Key
    version: int
    nbytes: int
    points: int
    box: tuple[float, float, float, float]
    z_min: float
    z_max: float
    handle: bytes = b""
    stale_handle: bytes = b""
    last_use_s: float = 0.0
    load_ns: int = 0
    hits: int = 0
    checked: bool = True
    sessions: set[int] = field(default_factory=set)


@dataclass(slots=True, eq=False)
class Zombie:
    """A retired segment; ``resident`` says what it was.

    ``probe_after_s`` is when its pins are next worth a look, ``condemned`` that nobody had it open
    at the last look, ``interval_s`` how long the last wait between two looks was.
    """

    resident: Resident
    condemned: bool = False
    probe_after_s: float = 0.0
    interval_s: float = 0.0


@dataclass(slots=True, eq=False)
class Load:
    """A load that is queued or running; ``reserved`` bytes are promised to it while it runs.

    ``adopted`` is the segment of an earlier life that only has to be checked; ``wanted`` that somebody
    asked for it.
    """

    key: Key
    estimate: int
    priority: float
    number: int
    asker: Hashable = None
    running: bool = False
    reserved: int = 0
    started_s: float = 0.0
    adopted: Resident | None = None
    wanted: bool = True


@dataclass(slots=True)
class Failure:
    """Why the last load of a key failed, and when asking again is worth another try.

    ``stamp`` is the state of the file that it failed for: another state is tried at once.  None, if it is
    not known or nobody should look (its file system may be what hangs).
    """

    code: str
    message: str
    stamp: tuple[int, int, int] | None
    retry_at_s: float
    delay_s: float


@dataclass(slots=True, eq=False)
class Slot:
    """Everything about one key; ``waiting`` counts the requests that wait for it."""

    resident: Resident | None = None
    load: Load | None = None
    failure: Failure | None = None
    waiting: int = 0


class Residency:
    """The books of one daemon.

    Parameters
    ----------
    budget_bytes
        Never exceeded by resident, zombie and reserved bytes together.

    Attributes
    ----------
    overhead_bytes
        What the daemon itself keeps in shared memory (its statistics); counts as used.
    unchecked_count
        How many residents are of an earlier life and not yet checked.
    """

    def __init__(self, budget_bytes: int) -> None:
        self.budget_bytes = budget_bytes
        self.slots: dict[Key, Slot] = {}
        self.zombies: dict[str, Zombie] = {}
        self.resident_bytes = 0
        self.zombie_bytes = 0
        self.reserved_bytes = 0
        self.overhead_bytes = 0
        self.unchecked_count = 0
        self._by_name: dict[str, Resident] = {}
        self._failed: dict[str, dict[Key, None]] = {}  # by code, those that failed longest ago first
        self._queue: LoadQueue[Load] = LoadQueue()
        self._numbers = 0

    # --- sums ---------------------------------------------------------------------------------

    @property
    def used_bytes(self) -> int:
        """Resident, zombie and reserved bytes together, and the daemon's own overhead."""
        return self.resident_bytes + self.zombie_bytes + self.reserved_bytes + self.overhead_bytes

    def shortage(self, nbytes: int) -> int:
        """How many bytes must be freed before ``nbytes`` more fit; 0 or less when they fit."""
        return self.used_bytes + nbytes - self.budget_bytes

    @property
    def resident_count(self) -> int:
        """How many segments can be handed out."""
        return len(self._by_name)

    def residents(self) -> Iterator[Resident]:
        """All segments that can be handed out."""
        return iter(self._by_name.values())

    def resident_named(self, name: str) -> Resident | None:
        """The segment of that name, if it can be handed out."""
        return self._by_name.get(name)

    def slot(self, key: Key) -> Slot:
        """The slot of a key, made when missing."""
        slot = self.slots.get(key)
        if slot is None:
            slot = self.slots[key] = Slot()
        return slot

    def unwait(self, key: Key) -> None:
        """A request does not wait for this key any more."""
        self.slots[key].waiting -= 1
        self.forget_if_empty(key)

    def forget_if_empty(self, key: Key) -> None:
        """Drop a slot that says nothing."""
        slot = self.slots.get(key)
        if slot is not None and not (slot.resident or slot.load or slot.failure or slot.waiting):
            del self.slots[key]

    # --- loads --------------------------------------------------------------------------------

    @property
    def queued(self) -> int:
        """How many loads wait for a worker or for room."""
        return len(self._queue)

    def queued_of(self, asker: Hashable) -> int:
        """How many of those somebody asked for."""
        return self._queue.count(asker)

    def want(self, key: Key, estimate: int, priority: float, asker: Hashable = None) -> Load:
        """Queue a load, or move a queued one forward; however many ask, there is one load.

        Those who ask take turns, in `LoadQueue`.
        """
        slot = self.slot(key)
        load = slot.load
        if load is None:
            self._numbers += 1
            load = slot.load = Load(key, estimate, priority, self._numbers, asker=asker)
            self._queue.push(load, priority, asker)
            return load
        load.wanted = True
        if not load.running:
            load.priority = min(load.priority, priority)
            self._queue.push(load, priority, asker)
        return load

    def next_queued(self) -> Load | None:
        """The queued load nearest to whose turn it is, or None."""
        while (load := self._queue.next()) is not None:
            slot = self.slots.get(load.key)
            if slot is not None and slot.load is load and not load.running:
                return load
            self._queue.discard(load)  # given up meanwhile
        return None

    def start(self, load: Load, now_s: float) -> None:
        """Reserve the load's bytes and count it as running.

        Raises
        ------
        ValueError
            If they do not fit; callers ask `shortage` first.
        """
        if load.estimate and self.shortage(load.estimate) > 0:
            raise ValueError("the reservation exceeds the budget")
        self._queue.started(load)
        load.running = True
        load.started_s = now_s
        load.reserved = load.estimate
        self.reserved_bytes += load.reserved

    def grow(self, load: Load, nbytes: int) -> bool:
        """Raise a running load's reservation to ``nbytes``; False if that does not fit."""
        extra = nbytes - load.reserved
        if extra > 0:
            if self.shortage(extra) > 0:
                return False
            load.reserved += extra
            self.reserved_bytes += extra
        return True

    def requeue(self, load: Load) -> None:
        """Put a running load back (its worker died before its turn)."""
        self._unreserve(load)
        load.running = False
        self._queue.push(load, load.priority, load.asker)

    def _unreserve(self, load: Load) -> None:
        self.reserved_bytes -= load.reserved
        load.reserved = 0

    def loaded(self, load: Load, resident: Resident) -> Resident | None:
        """The load is published; returns the version it supersedes, to be retired by name."""
        slot = self.slot(load.key)
        self._unreserve(load)
        if slot.load is load:
            slot.load = None
        slot.failure = None
        old = slot.resident
        slot.resident = resident
        self._by_name[resident.name] = resident
        self.resident_bytes += resident.nbytes
        if old is not None:
            self._move_to_zombies(old)
        return old

    def adopt(self, resident: Resident) -> None:
        """Take a segment of an earlier life into service once it is checked; queues that check, last."""
        load = self.want(resident.key, 0, float("inf"))
        load.adopted, load.wanted = resident, False
        self.slots[resident.key].resident = resident
        resident.checked = False
        self.unchecked_count += 1
        self._by_name[resident.name] = resident
        self.resident_bytes += resident.nbytes

    def checked(self, load: Load, resident: Resident) -> None:
        """An adopted segment is what it should be: it can be handed out."""
        self._unreserve(load)
        slot = self.slot(load.key)
        if slot.load is load:
            slot.load = None
        resident.checked = True
        self.unchecked_count -= 1

    def failed(self, load: Load, failure: Failure | None) -> None:
        """The load ended without a segment; ``failure`` stands until it succeeds or is cleared."""
        self._unreserve(load)
        self._queue.discard(load)
        slot = self.slots.get(load.key)
        if slot is not None and slot.load is load:
            slot.load = None
            slot.failure = failure
            if failure is not None:
                keys = self._failed.setdefault(failure.code, {})
                keys.pop(load.key, None)
                keys[load.key] = None
                if len(keys) > MOST_FAILURES:
                    oldest = next(iter(keys))
                    del keys[oldest]
                    self._forget_failure(oldest, failure.code)
            self.forget_if_empty(load.key)

    def cancel(self, key: Key) -> None:
        """Drop a queued load and a standing failure of a key (its cell left the map)."""
        slot = self.slots.get(key)
        if slot is None:
            return
        slot.failure = None
        if slot.load is not None and not slot.load.running:
            self._queue.discard(slot.load)
            slot.load = None
        self.forget_if_empty(key)

    def clear_failures(self, codes: frozenset[str]) -> None:
        """Forget standing failures of these kinds: what caused them may have passed."""
        for code in codes:
            for key in self._failed.pop(code, ()):
                self._forget_failure(key, code)

    def _forget_failure(self, key: Key, code: str) -> None:
        slot = self.slots.get(key)
        if slot is not None and slot.failure is not None and slot.failure.code == code:
            slot.failure = None
            self.forget_if_empty(key)

    # --- retiring -----------------------------------------------------------------------------

    def _move_to_zombies(self, resident: Resident) -> Zombie:
        del self._by_name[resident.name]
        self.unchecked_count -= not resident.checked
        self.resident_bytes -= resident.nbytes
        self.zombie_bytes += resident.nbytes
        zombie = self.zombies[resident.name] = Zombie(resident)
        return zombie

    def rename(self, resident: Resident, name: str) -> None:
        """A segment has another name from now on."""
        if resident.name in self._by_name:
            self._by_name[name] = self._by_name.pop(resident.name)
        else:
            self.zombies[name] = self.zombies.pop(resident.name)
        resident.name = name

    def retire(self, resident: Resident) -> Zombie:
        """Nobody gets this segment any more; its bytes count until `freed`."""
        slot = self.slots[resident.key]
        if slot.resident is resident:
            slot.resident = None
        zombie = self._move_to_zombies(resident)
        self.forget_if_empty(resident.key)
        return zombie

    def adopt_zombie(self, resident: Resident) -> Zombie:
        """Count a retired segment left by an earlier life of the daemon."""
        self.zombie_bytes += resident.nbytes
        zombie = self.zombies[resident.name] = Zombie(resident)
        return zombie

    def revive(self, zombie: Zombie) -> Resident | None:
        """A retired segment is wanted again and still whole: hand it out as before.

        Returns the version that it supersedes, to be retired by name (the map went back to an
        earlier state).
        """
        resident = zombie.resident
        slot = self.slot(resident.key)
        old = slot.resident
        if old is not None:
            self._move_to_zombies(old)
        del self.zombies[resident.name]
        self.zombie_bytes -= resident.nbytes
        self.resident_bytes += resident.nbytes
        self._by_name[resident.name] = resident
        slot.resident = resident
        slot.failure = None
        return old

    def freed(self, name: str) -> int:
        """A zombie's memory is back with the kernel; returns its bytes."""
        zombie = self.zombies.pop(name)
        self.zombie_bytes -= zombie.resident.nbytes
        return zombie.resident.nbytes

    def condemned_bytes(self) -> int:
        """Bytes of zombies that nobody had open at the last look: they are about to be freed."""
        return sum(z.resident.nbytes for z in self.zombies.values() if z.condemned)

    def candidates(self, now_s: float, grace_s: float) -> tuple[list[Resident], list[Resident]]:
        """Residents that may be retired now, and those that may be soon, first come first.

        Left out are those a waiting request needs.  Those handed out less than ``grace_s`` ago come
        second: their reader may not have opened them yet.
        """
        free: list[Resident] = []
        graced: list[Resident] = []
        for resident in self._by_name.values():
            if not self.slots[resident.key].waiting:
                (graced if resident.last_use_s + grace_s > now_s else free).append(resident)
        graced.sort(key=lambda resident: resident.last_use_s)
        return free, graced

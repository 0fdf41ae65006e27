# SPDX-License-Identifier: Apache-2.0
"""Getting memory back: retire a segment by renaming it, free it once the kernel says nobody has it.

Renaming first means that nobody new can open the segment; looking again on a later tick catches
whoever was just opening it.  A segment that is still mapped stays in the books as a zombie, and is
looked at again when its reader says that it let go, when the kernel reports that somebody closed it,
or when a client's process ends; on a timer only as a precaution.
"""

from __future__ import annotations

import contextlib
import enum
import logging
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Final

from shmmap.daemon.cache.eviction_policy import EvictionPolicy
from shmmap.daemon.cache.ledger import Key, Residency, Resident, Zombie
from shmmap.daemon.pins.probe import Rung
from shmmap.daemon.pins.watch import PinWatch
from shmmap.daemon.transport.sessions import Sessions
from shmmap.protocol.messages import Holder
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.names import another_name, zombie_name
from shmmap.segment.pins import LOADER_SLOT, holders

__all__ = ["UNKNOWN_SLOT", "Outcome", "Reclaimer"]

_log = logging.getLogger(__name__)

TICK_S: Final = 0.002
"""A retired segment is looked at again this much later: an ``open`` in flight is over by then."""
ZOMBIE_INTERVAL_S: Final = 0.1
"""How often a segment that is still mapped is looked at where the kernel does not report closes."""
WATCHED_INTERVAL_S: Final = 5.0
"""How often, at most, where it does: a precaution.  A report comes a moment before the close counts,
so the first looks after it follow each other quickly."""
ZOMBIE_SHARE_S: Final = 0.0005
"""With very many of them each is looked at less often: at most one per this time (a look takes 15 us)."""
HAND_OUT_GRACE_S: Final = 1.0
"""A segment just handed out is not evicted for this long, so that its reader can open it."""
PROBES_AT_ONCE: Final = 64
"""Looks per turn of the serving loop (about 15 us each)."""
HOLDERS_S: Final = 0.03
"""Time of the processor that finding out who holds what may take for one reply."""
UNKNOWN_SLOT: Final = 0
"""Stands for whoever uses a segment without being a session."""
PIN_MEMO_S: Final = 0.2
"""How long a segment found pinned is not considered again for eviction."""


class Outcome(enum.Enum):
    """What an attempt to make room came to."""

    PENDING = "room is on its way: try again later"
    IMPOSSIBLE = "everything else is pinned"


def _nothing(resident: Resident) -> None:
    del resident


def _nothing_of_names(name: str) -> None:
    del name


def _nothing_more(resident: Resident, why: str) -> None:
    del resident, why


class Reclaimer:
    """Carries out what the books decide about memory.

    Parameters
    ----------
    pins
        Asks the kernel, and hears from it.

    Attributes
    ----------
    evicted_count
        Segments retired to make room.
    on_retired, on_freed
        Called with a segment that left service and why (``room``, ``request``, ``map``,
        ``superseded``), and with one whose memory went back.
    on_renamed
        Called with a name that a segment does not have any more; it has another.
    wake_s
        When `free` is worth calling again although nothing changed (hand-out grace ends).
    """

    def __init__(
        self,
        residency: Residency,
        directory: ShmDirectory,
        sessions: Sessions,
        policy: EvictionPolicy,
        pins: PinWatch | None = None,
    ) -> None:
        self.pins = pins or PinWatch(directory)
        self._books = residency
        self._directory = directory
        self._sessions = sessions
        self._policy = policy
        self._pinned_until_s: dict[str, float] = {}
        self._by_key: dict[Key, Zombie] = {}
        self.on_retired: Callable[[Resident, str], None] = _nothing_more
        self.on_freed: Callable[[Resident], None] = _nothing
        self.on_renamed: Callable[[str], None] = _nothing_of_names
        self.evicted_count = 0
        self.wake_s = float("inf")

    # --- retiring -----------------------------------------------------------------------------

    def _on_disk(self, resident: Resident) -> str:
        return zombie_name(resident.name) if resident.name in self._books.zombies else resident.name

    def is_pinned(self, resident: Resident) -> bool | None:
        """The kernel's word on a segment; None if its name is gone."""
        if self.pins.rung is Rung.SESSIONS:
            return bool(resident.sessions)
        return self.pins.is_used(self._on_disk(resident))

    def retire(self, resident: Resident, now_s: float, why: str = "request") -> bool:
        """Take a segment out of service; True if nobody has it mapped, so that it is freed soon."""
        found = self._hide(resident)
        zombie = self._books.retire(resident)
        self.on_retired(resident, why)
        if not found:
            self._forget(zombie)
            return True
        return self._watch(zombie, now_s)

    def superseded(self, old: Resident, now_s: float) -> None:
        """The books moved an old version to the zombies; do the same with its name."""
        found = self._hide(old)
        zombie = self._books.zombies[old.name]
        self.on_retired(old, "superseded")
        if found:
            self._watch(zombie, now_s)
        else:
            self._forget(zombie)

    def _hide(self, resident: Resident) -> bool:
        """Give a segment the name of a retired one; False if it is gone.

        Where everybody may make files somebody may have taken that name: then it is a name nobody knows.
        """
        try:
            return self._directory.rename(resident.name, zombie_name(resident.name))
        except OSError as error:
            old, new = resident.name, another_name(resident.name)
            _log.warning("%s is not to be had (%s)", zombie_name(old), error.strerror)
            found = self._directory.rename(old, zombie_name(new))
            self._books.rename(resident, new)
            self.on_renamed(old)
            return found

    def _watch(self, zombie: Zombie, now_s: float) -> bool:
        if zombie.resident.checked:
            self._by_key[zombie.resident.key] = zombie
        self.pins.keep(zombie_name(zombie.resident.name))
        zombie.condemned = self.is_pinned(zombie.resident) is False
        zombie.probe_after_s = now_s + TICK_S
        return zombie.condemned

    def adopt(self, resident: Resident, now_s: float) -> None:
        """Watch a retired segment of an earlier life of the daemon."""
        zombie = self._books.adopt_zombie(resident)
        self.pins.keep(zombie_name(resident.name))
        zombie.probe_after_s = now_s + TICK_S

    def revive(self, key: Key, version: int, now_s: float) -> Resident | None:
        """Put a retired but still existing segment of exactly this version back into service."""
        zombie = self._by_key.get(key)
        if zombie is None or zombie.resident.version != version:
            return None
        try:
            found = self._directory.rename(zombie_name(zombie.resident.name), zombie.resident.name)
        except OSError as error:  # somebody else has taken its name: the cell is loaded anew
            _log.warning("%s is not to be had (%s)", zombie.resident.name, error.strerror)
            self.never_revive(key)
            return None
        if not found:
            self._forget(zombie)
            return None
        self.pins.release(zombie_name(zombie.resident.name))
        del self._by_key[key]
        old = self._books.revive(zombie)
        if old is not None:
            self.superseded(old, now_s)
        return zombie.resident

    def never_revive(self, key: Key) -> None:
        """What is retired of this key must not be handed out again."""
        self._by_key.pop(key, None)

    def _forget(self, zombie: Zombie) -> int:
        resident = zombie.resident
        self.pins.release(zombie_name(resident.name))
        if self._by_key.get(resident.key) is zombie:
            del self._by_key[resident.key]
        for slot in list(resident.sessions):
            session = self._sessions.by_slot(slot)
            if session is not None:
                session.drop_segment(resident)
        self.on_freed(resident)
        return self._books.freed(resident.name)

    # --- freeing ------------------------------------------------------------------------------

    def sweep(self, now_s: float) -> int:
        """Look at the zombies that are due and free those nobody has; returns the bytes freed."""
        freed = 0
        due = [z for z in self._books.zombies.values() if z.probe_after_s <= now_s]
        for zombie in due[:PROBES_AT_ONCE]:
            freed += self._probe(zombie, now_s)
        return freed

    def let_go(self, residents: Iterable[Resident], now_s: float) -> int:
        """Somebody dropped these: free what nobody else has; returns the bytes freed."""
        freed = 0
        for resident in residents:
            self._pinned_until_s.pop(resident.name, None)
            zombie = self._books.zombies.get(resident.name)
            if zombie is not None:
                freed += self._probe(zombie, now_s)
        return freed

    def _probe(self, zombie: Zombie, now_s: float) -> int:
        pinned = self.is_pinned(zombie.resident)
        if pinned:
            zombie.condemned = False
            zombie.probe_after_s = now_s + self._interval_s(zombie)
            return 0
        if pinned is False and now_s < zombie.probe_after_s:
            zombie.condemned = True  # its tick is not over yet
            return 0
        self._directory.unlink(zombie_name(zombie.resident.name))
        return self._forget(zombie)

    def _interval_s(self, zombie: Zombie) -> float:
        """When to look again at a segment that was found in use."""
        if self.pins.keeps(zombie_name(zombie.resident.name)):
            zombie.interval_s = min(max(TICK_S, 2 * zombie.interval_s), WATCHED_INTERVAL_S)
            return zombie.interval_s
        return max(ZOMBIE_INTERVAL_S, ZOMBIE_SHARE_S * len(self._books.zombies))

    def hear(self, now_s: float) -> bool:
        """Somebody closed something: free what nobody has now; whether anything may fit that did not."""
        names = self.pins.closed()
        zombies = self._books.zombies
        if names is None:
            self._pinned_until_s.clear()
            names = {zombie_name(name) for name in zombies}
        changed = False
        for name in names:
            zombie = zombies.get(name.removesuffix(zombie_name("")))
            if zombie is not None:
                zombie.interval_s = 0.0
                changed |= self._probe(zombie, now_s) > 0
            else:
                changed |= self._pinned_until_s.pop(name, None) is not None
        return changed

    def next_sweep_s(self) -> float:
        """When the next zombie is due; infinity when there is none."""
        return min((z.probe_after_s for z in self._books.zombies.values()), default=float("inf"))

    def free(self, shortage: int, now_s: float) -> Outcome:
        """Retire segments until ``shortage`` bytes are about to be freed.

        Looks at a bounded number per call; `Outcome.PENDING` means that calling again later helps.
        """
        self.wake_s = float("inf")
        missing = shortage - self._books.condemned_bytes()
        if missing <= 0:
            return Outcome.PENDING
        candidates, graced = self._books.candidates(now_s, HAND_OUT_GRACE_S)
        self._pinned_until_s = {name: t for name, t in self._pinned_until_s.items() if t > now_s}
        unknown = [r for r in candidates if r.name not in self._pinned_until_s]
        ordered = self._policy(unknown, self._sessions.poses())
        # what a session says it holds is most likely pinned: look at the others first
        ordered.sort(key=lambda resident: bool(resident.sessions))
        for resident in ordered[:PROBES_AT_ONCE]:
            if self.is_pinned(resident):
                self._pinned_until_s[resident.name] = now_s + PIN_MEMO_S
                self.pins.tell_once(resident.name)
                continue
            missing -= resident.nbytes
            self.retire(resident, now_s, "room")
            self.evicted_count += 1
            if missing <= 0:
                return Outcome.PENDING
        if len(ordered) > PROBES_AT_ONCE:
            self.wake_s = now_s
            return Outcome.PENDING
        # their readers may be just opening these; those that have done so are no reason to wait
        unknown = [r for r in graced if r.name not in self._pinned_until_s]
        for resident in unknown[:PROBES_AT_ONCE]:
            if not self.is_pinned(resident):
                self.wake_s = resident.last_use_s + HAND_OUT_GRACE_S
                return Outcome.PENDING
            self._pinned_until_s[resident.name] = now_s + PIN_MEMO_S
        if len(unknown) > PROBES_AT_ONCE:
            self.wake_s = now_s
            return Outcome.PENDING
        return Outcome.PENDING if self._books.condemned_bytes() >= shortage else Outcome.IMPOSSIBLE

    # --- who ----------------------------------------------------------------------------------

    def slots_of(self, resident: Resident) -> list[int] | None:
        """Slots that have a segment locked; None if its name is gone."""
        try:
            with self.pins.opened(self._on_disk(resident)) as fd:
                return holders(fd)
        except OSError:
            return None

    def users_among(self, resident: Resident, slots: Sequence[int]) -> list[int]:
        """Slots of sessions, of those that have a segment locked, and 0 if somebody unknown uses it, too.

        Unknown is whose lock no session of ours has (a client of an earlier life that we have not heard
        of), and a pin without any lock.  Our own loaders look at segments, too, and do not count.
        """
        known = [slot for slot in slots if self._sessions.by_slot(slot) is not None]
        ours = slots.count(LOADER_SLOT)
        if len(slots) > len(known) + ours or (not known and not ours and self.is_pinned(resident)):
            known.append(UNKNOWN_SLOT)
        return known

    def holders_of(self, residents: Iterable[Resident], *, limit: int = 512) -> tuple[Holder, ...]:
        """Who keeps these segments, largest first; session 0 is "unknown": a pin without our lock.

        A bounded look: at so many segments, and for so long.
        """
        end_s = time.thread_time() + HOLDERS_S
        bytes_of: dict[int, int] = {}
        cells_of: dict[int, int] = {}
        for count, resident in enumerate(residents):
            if count >= limit or time.thread_time() > end_s:
                break
            for slot in self.users_among(resident, self.slots_of(resident) or ()):
                bytes_of[slot] = bytes_of.get(slot, 0) + resident.nbytes
                cells_of[slot] = cells_of.get(slot, 0) + 1
        found = []
        for slot, nbytes in sorted(bytes_of.items(), key=lambda item: -item[1]):
            session = self._sessions.by_slot(slot)
            if session is None:
                found.append(Holder(0, 0, -1, "unknown", nbytes, cells_of[slot]))
            else:
                found.append(session.as_holder(nbytes, cells_of[slot]))
        return tuple(found)

    def everything(self) -> list[Resident]:
        """All segments in memory, retired ones included, largest first."""
        found = [*self._books.residents(), *(z.resident for z in self._books.zombies.values())]
        return sorted(found, key=lambda resident: -resident.nbytes)

    def remove_all(self) -> None:
        """Take every name away; memory goes back as soon as its last reader ends."""
        for resident in self.everything():
            with contextlib.suppress(OSError):
                self._directory.unlink(self._on_disk(resident))

    def close(self) -> None:
        """Hear of nothing any more."""
        self.pins.close()

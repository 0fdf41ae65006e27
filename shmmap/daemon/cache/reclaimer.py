# SPDX-License-Identifier: Apache-2.0
"""Getting memory back: retire a segment by renaming it, free it once the kernel says nobody has it.

Renaming first means that nobody new can open the segment; looking again on a later tick catches
whoever was just opening it.  A retired segment that is still mapped stays in the ledger, and is
looked at again when its reader says that it let go, when the kernel reports that somebody closed it,
or when a client's session ends; on a timer only as a precaution.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Final

from shmmap.daemon.cache.eviction_policy import EvictionPolicy
from shmmap.daemon.cache.ledger import Ledger
from shmmap.daemon.pins.probe import PinSource
from shmmap.daemon.pins.watch import PinWatch
from shmmap.daemon.records import Key, Resident, Retired
from shmmap.daemon.transport.sessions import Sessions
from shmmap.logfmt import log
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.names import another_name, retired_name

__all__ = ["Reclaimer"]

TICK_S: Final = 0.002
"""A retired segment is looked at again this much later: an ``open`` in flight is over by then."""
RETIRED_INTERVAL_S: Final = 0.1
"""How often a segment that is still mapped is looked at where the kernel does not report closes."""
WATCHED_INTERVAL_S: Final = 5.0
"""How often, at most, where it does: a precaution.  A report comes a moment before the close counts,
so the first looks after it follow each other quickly."""
RETIRED_SHARE_S: Final = 0.0005
"""With very many of them each is looked at less often: at most one per this time (a look takes 15 us)."""
HAND_OUT_GRACE_S: Final = 1.0
"""A segment just handed out is not evicted for this long, so that its reader can open it."""
PROBES_AT_ONCE: Final = 64
"""Looks per turn of the serving loop (about 15 us each)."""
PIN_MEMO_S: Final = 0.2
"""How long a segment found pinned is not considered again for eviction."""


@dataclass(eq=False, slots=True)
class Reclaimer:
    """Carries out what the ledger and the eviction policy decide about memory.

    Parameters
    ----------
    pins
        Asks the kernel, and hears from it.

    Attributes
    ----------
    on_retired
        Called with a segment that left service, and why: for ``room``, ``request``, ``map``, ``superseded``
        or ``damaged``.
    on_gone
        Called with a name under which there is no segment any more: it was freed, or has another.
    evicted_count
        Segments retired to make room.
    wake_s
        When `free` is worth calling again although nothing changed (hand-out grace ends).
    """

    ledger: Ledger
    directory: ShmDirectory
    sessions: Sessions
    policy: EvictionPolicy
    pins: PinWatch
    on_retired: Callable[[Resident, str], None] = field(init=False)
    on_gone: Callable[[str], None] = field(init=False)
    evicted_count: int = 0
    wake_s: float = math.inf
    _pinned_until_s: dict[str, float] = field(default_factory=dict)
    _by_key: dict[Key, Retired] = field(default_factory=dict)

    # --- retiring -----------------------------------------------------------------------------

    def name_on_disk(self, resident: Resident) -> str:
        """The name of a segment's file: a retired one has another."""
        return retired_name(resident.name) if resident.name in self.ledger.retired else resident.name

    def is_pinned(self, resident: Resident) -> bool | None:
        """What the kernel says of a segment; None if its name is gone."""
        if self.pins.source is PinSource.SESSIONS:
            return bool(resident.sessions)
        return self.pins.is_used(self.name_on_disk(resident))

    def retire(self, resident: Resident, now_s: float, why: str = "request") -> bool:
        """Take a segment out of service; True if nobody has it mapped, so that it is freed soon."""
        found = self._hide(resident)
        self.ledger.retire(resident)
        return self._watch(resident, now_s, why, found=found)

    def superseded(self, old: Resident, now_s: float) -> None:
        """The ledger took an old version out of service; do the same with its name."""
        self._watch(old, now_s, "superseded", found=self._hide(old))

    def _hide(self, resident: Resident) -> bool:
        """Give a segment the name of a retired one; False if it is gone.

        Where everybody may make files somebody may have taken that name: then it is a name nobody knows.
        """
        try:
            return self.directory.rename(resident.name, retired_name(resident.name))
        except OSError as error:
            old, new = resident.name, another_name(resident.name)
            log.warning("segment not renamed", old=old, new=retired_name(old), error=error.strerror)
            found = self.directory.rename(old, retired_name(new))
            self.ledger.rename(resident, new)
            self.on_gone(old)
            return found

    def _watch(self, resident: Resident, now_s: float, why: str, *, found: bool) -> bool:
        """Have an eye on a segment out of service; True if nobody has it mapped."""
        retired = self.ledger.retired[resident.name]
        self.on_retired(resident, why)
        if not found:
            self._forget(retired)
            return True
        if resident.checked:
            self._by_key[resident.key] = retired
        self.pins.keep(retired_name(resident.name))
        retired.condemned = self.is_pinned(resident) is False
        retired.probe_after_s = now_s + TICK_S
        return retired.condemned

    def adopt(self, resident: Resident, now_s: float) -> None:
        """Watch a retired segment of an earlier life of the daemon."""
        self.ledger.add_retired(resident).probe_after_s = now_s + TICK_S
        self.pins.keep(retired_name(resident.name))

    def may_revive(self, key: Key) -> bool:
        """Whether a segment is retired that could be handed out again, if its version is the current one."""
        return key in self._by_key

    def revive(self, key: Key, version: int, now_s: float) -> Resident | None:
        """Put a retired but still existing segment of exactly this version back into service."""
        retired = self._by_key.get(key)
        if retired is None or retired.resident.version != version:
            return None
        name = retired.resident.name
        try:
            found = self.directory.rename(retired_name(name), name)
        except OSError as error:  # somebody else has taken its name: the cell is loaded anew
            log.warning("segment not renamed", old=retired_name(name), new=name, error=error.strerror)
            self.never_revive(key)
            return None
        if not found:
            self._forget(retired)
            return None
        self.pins.release(retired_name(name))
        del self._by_key[key]
        old = self.ledger.revive(retired)
        if old is not None:
            self.superseded(old, now_s)
        return retired.resident

    def never_revive(self, key: Key) -> None:
        """What is retired of this key must not be handed out again."""
        self._by_key.pop(key, None)

    def _forget(self, retired: Retired) -> int:
        resident = retired.resident
        self.pins.release(retired_name(resident.name))
        if self._by_key.get(resident.key) is retired:
            del self._by_key[resident.key]
        for slot in list(resident.sessions):
            session = self.sessions.by_slot(slot)
            if session is not None:
                session.drop_segment(resident)
        self.on_gone(resident.name)
        return self.ledger.freed(resident.name)

    # --- freeing ------------------------------------------------------------------------------

    def sweep(self, now_s: float) -> int:
        """Look at the retired segments that are due and free those nobody has; returns the bytes freed."""
        due = [one for one in self.ledger.retired.values() if one.probe_after_s <= now_s]
        return sum(self._probe(one, now_s) for one in due[:PROBES_AT_ONCE])

    def let_go(self, residents: Iterable[Resident], now_s: float) -> None:
        """Somebody dropped these: free what nobody else has."""
        for resident in residents:
            self._pinned_until_s.pop(resident.name, None)
            retired = self.ledger.retired.get(resident.name)
            if retired is not None:
                self._probe(retired, now_s)

    def _probe(self, retired: Retired, now_s: float) -> int:
        used = self.is_pinned(retired.resident)
        if used:
            retired.condemned = False
            retired.probe_after_s = now_s + self._interval_s(retired)
            return 0
        if used is False and now_s < retired.probe_after_s:
            retired.condemned = True  # its tick is not over yet
            return 0
        self.directory.unlink(retired_name(retired.resident.name))
        return self._forget(retired)

    def _interval_s(self, retired: Retired) -> float:
        """When to look again at a segment that was found in use."""
        if self.pins.keeps(retired_name(retired.resident.name)):
            retired.interval_s = min(max(TICK_S, 2 * retired.interval_s), WATCHED_INTERVAL_S)
            return retired.interval_s
        return max(RETIRED_INTERVAL_S, RETIRED_SHARE_S * len(self.ledger.retired))

    def hear(self, now_s: float) -> bool:
        """Somebody closed something: free what nobody has now; whether anything may fit that did not."""
        names = self.pins.closed()
        if names is None:
            self._pinned_until_s.clear()
            names = {retired_name(name) for name in self.ledger.retired}
        changed = False
        for name in names:
            retired = self.ledger.retired.get(name.removesuffix(retired_name("")))
            if retired is not None:
                retired.interval_s = 0.0
                changed |= self._probe(retired, now_s) > 0
            else:
                changed |= self._pinned_until_s.pop(name, None) is not None
        return changed

    def next_sweep_s(self) -> float:
        """When the next look at a retired segment is due; infinity when there is none."""
        return min((one.probe_after_s for one in self.ledger.retired.values()), default=math.inf)

    def free(self, shortage: int, now_s: float) -> bool:
        """Retire segments until ``shortage`` bytes are about to be freed; False if all else is in use.

        Looks at a bounded number per call; True also means that calling again later helps.
        """
        self.wake_s = math.inf
        missing = shortage - self.ledger.condemned_bytes()
        if missing <= 0:
            return True
        candidates, graced = self.ledger.candidates(now_s, HAND_OUT_GRACE_S)
        self._pinned_until_s = {name: t for name, t in self._pinned_until_s.items() if t > now_s}
        unknown = [r for r in candidates if r.name not in self._pinned_until_s]
        ordered = self.policy(unknown, self.sessions.poses())
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
                return True
        if len(ordered) > PROBES_AT_ONCE:
            self.wake_s = now_s
            return True
        # their readers may be just opening these; those that have done so are no reason to wait
        unknown = [r for r in graced if r.name not in self._pinned_until_s]
        for resident in unknown[:PROBES_AT_ONCE]:
            if not self.is_pinned(resident):
                self.wake_s = resident.last_use_s + HAND_OUT_GRACE_S
                return True
            self._pinned_until_s[resident.name] = now_s + PIN_MEMO_S
        if len(unknown) > PROBES_AT_ONCE:
            self.wake_s = now_s
            return True
        return self.ledger.condemned_bytes() >= shortage

    # --- the end --------------------------------------------------------------------------------

    def remove_all(self) -> None:
        """Take every name away; memory goes back as soon as its last reader ends."""
        for resident in self.ledger.everything():
            with contextlib.suppress(OSError):
                self.directory.unlink(self.name_on_disk(resident))

# SPDX-License-Identifier: Apache-2.0
"""Getting memory back: retire a segment by renaming it, free it once the kernel says nobody has it.

A bounded number of segments is looked at per turn of the serving loop; a longer way goes on in the next.

Renaming first means that nobody new can open the segment; looking again on a later tick catches
whoever was just opening it.  A retired segment that is still mapped stays in the ledger, and is
looked at again when its reader says that it let go, when the kernel reports that somebody closed it,
or when a client's session ends; on a timer only as a precaution.
"""

from __future__ import annotations

import contextlib
import heapq
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import islice
from typing import Final

from shmmap.daemon.cache.ledger import Ledger
from shmmap.daemon.pins.probe import PinSource
from shmmap.daemon.pins.watch import PinWatch
from shmmap.daemon.records import Key, Resident, Retired
from shmmap.daemon.transport.sessions import Sessions
from shmmap.logfmt import log
from shmmap.segment.closer import Closer
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
SHARE_S: Final = 0.0005
"""With very many of them each is looked at less often: at most one per this time (a look takes 15 us)."""
HAND_OUT_GRACE_S: Final = 1.0
"""A segment just handed out is not evicted for this long, so that its reader can open it."""
LOOKS_AT_ONCE: Final = 8
"""Segments looked at, retired or freed per turn: a look takes 15 us, retiring 50."""


@dataclass(eq=False, slots=True)
class Reclaimer:
    """Retires segments, and gives their memory back.

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
    closer
        Closes what takes long to close.
    """

    ledger: Ledger
    directory: ShmDirectory
    sessions: Sessions
    pins: PinWatch
    on_retired: Callable[[Resident, str], None] = field(init=False)
    on_gone: Callable[[str], None] = field(init=False)
    closer: Closer = field(default_factory=Closer)
    _by_key: dict[Key, Retired] = field(default_factory=dict)
    _due: list[tuple[float, int, Retired]] = field(default_factory=list)
    _number: int = 0
    _unheard: Iterator[Resident] = field(default_factory=lambda: iter(()))

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
            self._vanished(retired)
            return True
        if resident.checked:
            self._by_key[resident.key] = retired
        condemned = self.is_pinned(resident) is False
        if not condemned:
            self.pins.keep(retired_name(resident.name))
        self.ledger.condemn(retired, condemned)
        self._begin_tick(retired, now_s)
        return condemned

    def adopt(self, resident: Resident, now_s: float) -> None:
        """Watch a retired segment of an earlier life of the daemon."""
        self._begin_tick(self.ledger.add_retired(resident), now_s)
        self.pins.keep(retired_name(resident.name))

    def _begin_tick(self, retired: Retired, now_s: float) -> None:
        """It may be freed when nobody can be just opening it."""
        retired.tick_over_s = now_s + TICK_S
        self._look_at(retired, retired.tick_over_s)

    def _look_at(self, retired: Retired, when_s: float) -> None:
        """A retired segment is worth a look then."""
        retired.probe_after_s = when_s = max(when_s, retired.tick_over_s)
        self._number += 1
        heapq.heappush(self._due, (when_s, self._number, retired))

    def retired_of(self, key: Key) -> Resident | None:
        """The last segment of a key that left service, while there is one."""
        retired = self._by_key.get(key)
        return retired.resident if retired is not None else None

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
            self._vanished(retired)
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

    def _vanished(self, retired: Retired) -> None:
        """Release the bytes of a segment whose name others removed.

        Its readers keep its memory, and until when cannot be found out.
        """
        self._forget(retired)
        self.ledger.freed(retired.resident.name)

    def _forget(self, retired: Retired) -> None:
        """There is no such segment any more, or only its memory."""
        resident = retired.resident
        self.pins.release(retired_name(resident.name))
        if self._by_key.get(resident.key) is retired:
            del self._by_key[resident.key]
        for slot in list(resident.sessions):
            session = self.sessions.by_slot(slot)
            if session is not None:
                session.drop_segment(resident)
        self.on_gone(resident.name)

    # --- freeing ------------------------------------------------------------------------------

    def sweep(self, now_s: float) -> int:
        """Look at some retired segments that are due and free those nobody has; returns the bytes freed.

        Those whose memory is being freed in another thread do not count, see `collect`.
        """
        freed = 0
        for _ in range(LOOKS_AT_ONCE):
            retired = self._next_due(now_s)
            if retired is None:
                break
            freed += self._probe(retired, now_s)  # if that fails, its time has still come
        for resident in islice(self._unheard, LOOKS_AT_ONCE):
            retired = self.ledger.retired.get(resident.name)
            if retired is not None:
                self._look_at(retired, min(now_s, retired.probe_after_s))
        return freed

    def _next_due(self, now_s: float = math.inf) -> Retired | None:
        """The retired segment that is to be looked at next, if its time has come."""
        while self._due and self._due[0][0] <= now_s:
            when_s, _, retired = self._due[0]
            known = self.ledger.retired.get(retired.resident.name)
            if known is retired and when_s == retired.probe_after_s:
                return retired
            heapq.heappop(self._due)  # it is gone, or another time was set
        return None

    def next_sweep_s(self) -> float:
        """When the next look at a retired segment is due; infinity when there is none."""
        retired = self._next_due()
        return retired.probe_after_s if retired is not None else math.inf

    def let_go(self, residents: Iterable[Resident], now_s: float) -> None:
        """Somebody dropped these: what nobody else has is freed soon."""
        for resident in residents:
            retired = self.ledger.retired.get(resident.name)
            if retired is None:
                self.ledger.order.reconsider(resident)
            elif retired.probe_after_s > now_s and not retired.condemned:
                self._look_at(retired, now_s)

    def _probe(self, retired: Retired, now_s: float) -> int:
        """Look at a retired segment whose tick is over; returns the bytes that were freed."""
        if self.is_pinned(retired.resident):
            self.ledger.condemn(retired, False)
            name = retired_name(retired.resident.name)
            if not self.pins.keeps(name):
                self.pins.keep(name)
            self._look_at(retired, now_s + self._interval_s(retired))
            return 0
        if self.closer.full:
            self.ledger.condemn(retired, True)
            self._look_at(retired, now_s + TICK_S)
            return 0
        return self._free(retired)

    def _free(self, retired: Retired) -> int:
        """Remove a segment that nobody has; a large one's memory goes back in another thread."""
        resident = retired.resident
        name = retired_name(resident.name)
        fd = -1
        if resident.nbytes > self.closer.small_bytes:
            with contextlib.suppress(OSError):
                fd = self.directory.open_path(name)
        self.directory.unlink(name)
        self._forget(retired)
        if fd < 0:
            return self.ledger.freed(resident.name)
        self.closer.close(fd, self.ledger.freeing(resident.name))
        return 0

    def collect(self) -> int:
        """Count memory that the other thread has freed since the last time; returns its bytes."""
        nbytes = self.closer.closed()
        self.ledger.closed(nbytes)
        return nbytes

    def _interval_s(self, retired: Retired) -> float:
        """When to look again at a segment that was found in use."""
        if self.pins.keeps(retired_name(retired.resident.name)):
            retired.interval_s = min(max(TICK_S, 2 * retired.interval_s), WATCHED_INTERVAL_S)
            return retired.interval_s
        return max(RETIRED_INTERVAL_S, SHARE_S * len(self.ledger.retired))

    def hear(self, now_s: float) -> bool:
        """Somebody closed something: have a look at it; whether anything may fit that did not."""
        names = self.pins.closed()
        if names is None:
            self.ledger.order.reconsider_all()
            self._unheard = self.ledger.segments.walk()
            return True
        changed = False
        for name in names:
            retired = self.ledger.retired.get(name.removesuffix(retired_name("")))
            resident = self.ledger.resident_named(name)
            if retired is not None:
                retired.interval_s = 0.0
                if not retired.condemned:
                    self._look_at(retired, now_s)
            elif resident is not None:
                changed |= self.ledger.order.reconsider(resident)
        return changed

    # --- the end --------------------------------------------------------------------------------

    def close(self) -> None:
        """Let go of every descriptor."""
        self.closer.end()
        self.pins.close()

    def remove_all(self) -> None:
        """Take every name away; memory goes back as soon as its last reader ends."""
        for resident in self.ledger.segments.walk():
            with contextlib.suppress(OSError):
                self.directory.unlink(self.name_on_disk(resident))

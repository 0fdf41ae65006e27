# SPDX-License-Identifier: Apache-2.0
"""Who has a segment mapped: the sessions that hold their lock on it, and whoever is not known."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Final

from shmmap.daemon.cache.reclaimer import LOOKS_AT_ONCE, Reclaimer
from shmmap.daemon.pins.probe import PinSource
from shmmap.daemon.records import Resident
from shmmap.protocol.messages import Holder
from shmmap.segment.pins import LOADER_SLOT, has_slot, holders

__all__ = ["UNKNOWN_SLOT", "Holders"]

HOLDERS_S: Final = 0.03
"""Time of the processor that finding out who holds what may take for one reply."""
MOST_SEGMENTS: Final = 512
"""Segments looked at for one reply."""
UNKNOWN_SLOT: Final = 0
"""Stands for whoever uses a segment without being a session."""


@dataclass(eq=False, slots=True)
class Holders:
    """Asks the kernel who has segments locked, and the sessions who that is."""

    reclaimer: Reclaimer

    @property
    def by_slot(self) -> bool:
        """Whether the kernel tells which sessions use a segment."""
        return self.reclaimer.pins.source is not PinSource.SESSIONS

    def slots_of(self, resident: Resident) -> list[int] | None:
        """Slots that have a segment locked; None if its name is gone."""
        try:
            with self.reclaimer.pins.opened(self.reclaimer.name_on_disk(resident)) as fd:
                return holders(fd)
        except OSError:
            return None

    def has(self, resident: Resident, slot: int) -> bool:
        """Whether a session may have a segment locked: not, if its name is there and its lock is not."""
        try:
            with self.reclaimer.pins.opened(self.reclaimer.name_on_disk(resident)) as fd:
                return has_slot(fd, slot)
        except OSError:
            return True

    def users_among(self, resident: Resident, slots: Sequence[int]) -> list[int]:
        """Slots of sessions, of those that have a segment locked, and 0 if somebody unknown uses it, too.

        Unknown is whose lock no session of ours has (a client of an earlier life that we have not heard
        of), and a pin without any lock.  Our own loaders look at segments, too, and do not count.
        """
        known = [slot for slot in slots if self.reclaimer.sessions.by_slot(slot) is not None]
        ours = slots.count(LOADER_SLOT)
        if len(slots) > len(known) + ours or (not known and not ours and self.reclaimer.is_pinned(resident)):
            known.append(UNKNOWN_SLOT)
        return known

    def of(self, resident: Resident) -> tuple[Holder, ...]:
        """Who keeps a segment; session 0 is "unknown": a pin without our lock."""
        return tuple(self._told({slot: [resident.nbytes, 1] for slot in self._users_of(resident)}))

    def look(self, residents: Iterable[Resident], holders: list[Holder]) -> Iterator[None]:
        """Add who keeps these segments to ``holders``, largest first, when that is found out.

        A bounded look: at so many segments, and for so long; a few a turn.
        """
        spent_s, found = 0.0, dict[int, list[int]]()
        for number, resident in enumerate(islice(residents, MOST_SEGMENTS)):
            if number and number % LOOKS_AT_ONCE == 0:
                yield
            begin_s = time.thread_time()
            for slot in self._users_of(resident):
                sums = found.setdefault(slot, [0, 0])
                sums[0] += resident.nbytes
                sums[1] += 1
            spent_s += time.thread_time() - begin_s
            if spent_s > HOLDERS_S:
                break
        holders += self._told(found)

    def _users_of(self, resident: Resident) -> list[int]:
        return self.users_among(resident, self.slots_of(resident) or ())

    def _told(self, found: Mapping[int, Sequence[int]]) -> list[Holder]:
        """By slot, bytes and segments: as a reply says it."""
        holders = []
        for slot, (nbytes, cells) in sorted(found.items(), key=lambda item: -item[1][0]):
            session = self.reclaimer.sessions.by_slot(slot)
            if session is None:
                holders.append(Holder(0, 0, -1, "unknown", nbytes, cells))
            else:
                holders.append(session.as_holder(nbytes, cells))
        return holders

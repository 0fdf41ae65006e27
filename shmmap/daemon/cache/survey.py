# SPDX-License-Identifier: Apache-2.0
"""Who maps how much of the memory: asked of the kernel a few segments at a time.

Only the kernel knows.  One look at a segment takes about 30 us, and there may be thousands: there is one
walk over all of them, in slices.  A slice a beat keeps the gauges of the statistics up to date; when
somebody asks, a new walk begins and the serving loop does a slice a turn, and everybody who asked before
it began gets its result.  What a single session has is looked up in slices of the same size, in its own
turns, before it is refused what would be too much beside what it may have let go of.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Container, Generator, Iterator
from dataclasses import dataclass, field
from itertools import islice
from typing import Final

from shmmap.daemon.cache.holders import UNKNOWN_SLOT, Holders
from shmmap.daemon.cache.ledger import Ledger
from shmmap.daemon.records import Key, Resident
from shmmap.daemon.transport.sessions import Session
from shmmap.errors import Busy

__all__ = ["Share", "Survey", "Usage"]

LOOKS_AT_ONCE: Final = 8
"""A fifth of a millisecond of the serving loop."""
ASKING_S: Final = 0.2
"""Time of the processor that asking who holds what may take in one walk; 2048 segments take 0.03 s."""
STEP_S: Final = 0.001
LONG_STEP_S: Final = 0.003
SHARE: Final = 0.1
"""Part of the loop's time that steps get when they take long (somebody holds very many locks)."""
MOST_SEGMENTS: Final = 2048
"""Where somebody waits for the result, so many are looked at: the largest, of a session's the oldest."""
MOST_ASKED: Final = 16
"""Answers one session may wait for."""


@dataclass(slots=True)
class Share:
    """What one session maps; ``superseded`` segments have left service or have a successor."""

    mapped_bytes: int = 0
    superseded: int = 0
    superseded_bytes: int = 0


@dataclass(slots=True)
class Usage:
    """What the segments come to that somebody maps; ``unknown`` ones are mapped by nobody who told.

    ``shares`` goes by the slots of the sessions that map anything; without ``by_slot`` that cannot be told.
    """

    count: int = 0
    nbytes: int = 0
    unknown: int = 0
    unknown_bytes: int = 0
    shares: dict[int, Share] = field(default_factory=dict)
    by_slot: bool = True


Answer = Callable[[Usage], None]


class Survey:
    """Looks at all segments, a few per `step`.

    Attributes
    ----------
    usage : Usage
        What the last whole walk found.
    """

    def __init__(self, ledger: Ledger, holders: Holders, *, in_service: Callable[[Resident], bool]) -> None:
        self._ledger = ledger
        self._holders = holders
        self._in_service = in_service
        self._asked: list[tuple[Session, Answer]] = []
        self._running: list[tuple[Session, Answer]] = []
        self._left: Iterator[Resident] | None = None
        self.usage = self._found = Usage()
        self._rests_until_s = 0.0
        self._asking_s = 0.0

    @property
    def idle(self) -> bool:
        """Whether nobody waits for a result."""
        return not (self._asked or self._running)

    @property
    def next_s(self) -> float:
        """When `turn` has something to do: infinity for never."""
        return float("inf") if self.idle else self._rests_until_s

    def ask(self, session: Session, answer: Answer) -> None:
        """Have ``answer`` called with the result of a walk that begins after now.

        Raises
        ------
        Busy
            The session waits for too many already.
        """
        if sum(asker is session for asker, _ in self._asked) >= MOST_ASKED:
            raise Busy("this session waits for too many answers of this kind", hint="wait for them first")
        self._asked.append((session, answer))

    def run_step(self, now_s: float) -> None:
        """Do a step if somebody waits, unless the one before took so long that others come first."""
        if self.idle or now_s < self._rests_until_s:
            return
        self.step()
        took_s = time.monotonic() - now_s
        self._rests_until_s = now_s + took_s / SHARE if took_s > LONG_STEP_S else 0.0

    def look_at(
        self, session: Session, before_s: float, enough: Callable[[], bool], wanted: Container[Key] = ()
    ) -> Generator[None, None, None]:
        """Note what a session does not map any more, a few segments a turn, until that is ``enough``.

        Of what was handed out at ``before_s`` or later it may be about to open; what is ``wanted`` again
        counts either way.
        """
        if not self._holders.by_slot:
            return
        looked = 0
        for version in list(session.held):  # what was handed out longest ago first
            for resident in list(session.held.get(version, ())):
                if looked == MOST_SEGMENTS or enough():
                    return
                if resident.key in wanted:
                    continue
                looked += 1
                if looked % LOOKS_AT_ONCE == 0:
                    yield
                if resident.last_use_s < before_s and not self._holders.has(resident, session.slot):
                    session.drop_segment(resident)

    def step(self) -> None:
        """Look at a few segments, or hand the result to one who asked."""
        if self._asked and not self._running:
            self._running, self._asked = self._asked[::-1], []
            self._begin(MOST_SEGMENTS)
        elif self._running and self._left is None:
            _, answer = self._running.pop()
            answer(self.usage)
            return
        elif self._left is None:
            self._begin(None)
        self._look()

    def _begin(self, most: int | None) -> None:
        self._left = islice(self._ledger.segments.walk(), most)
        self._found = Usage(by_slot=self._holders.by_slot)
        self._asking_s = 0.0

    def _slots_of(self, resident: Resident) -> list[int]:
        """Who has a segment locked, as far as there is time to ask: else its pin counts as unknown."""
        if self._asking_s > ASKING_S:
            return []
        begin_s = time.thread_time()
        slots = self._holders.slots_of(resident) or []
        self._asking_s += time.thread_time() - begin_s
        return slots

    def _look(self) -> None:
        found, end_s = self._found, time.thread_time() + STEP_S
        for _ in range(LOOKS_AT_ONCE):
            if time.thread_time() > end_s:
                break  # somebody holds very many locks
            resident = next(self._left, None) if self._left is not None else None
            if resident is None:
                self._left, self.usage = None, found
                break
            users = self._holders.users_among(resident, self._slots_of(resident))
            if users:
                found.count += 1
                found.nbytes += resident.nbytes
            for slot in users:
                if slot == UNKNOWN_SLOT:
                    found.unknown += 1
                    found.unknown_bytes += resident.nbytes
                else:
                    self._add(found.shares.setdefault(slot, Share()), resident)

    def _add(self, share: Share, resident: Resident) -> None:
        share.mapped_bytes += resident.nbytes
        if not self._in_service(resident):
            share.superseded += 1
            share.superseded_bytes += resident.nbytes

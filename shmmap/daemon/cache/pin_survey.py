# SPDX-License-Identifier: Apache-2.0
"""How much memory is pinned, and how much of it by nobody known: asked of the kernel bit by bit.

One look at a segment takes about 30 us, and there may be thousands: the serving loop does a few per
turn, and everybody who asked meanwhile gets the result of one survey.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from shmmap.daemon.cache.reclaimer import UNKNOWN_SLOT, Reclaimer
from shmmap.daemon.records import Resident
from shmmap.daemon.transport.sessions import Session
from shmmap.errors import Busy

__all__ = ["PinSurvey", "Pinned", "Share"]

LOOKS_AT_ONCE: Final = 16
"""Half a millisecond of the serving loop."""
ASKING_S: Final = 0.2
"""Time of the processor that asking who holds what may take in one survey; 2048 segments take 0.03 s."""
STEP_S: Final = 0.001
LONG_STEP_S: Final = 0.003
SHARE: Final = 0.1
"""Part of the loop's time that steps get when they take long (somebody holds very many locks)."""
MOST_SEGMENTS: Final = 2048
"""The largest are looked at."""
MOST_ASKED: Final = 16
"""Answers one session may wait for."""


@dataclass(slots=True)
class Share:
    """What one session maps; ``superseded`` segments have left service or have a successor."""

    mapped_bytes: int = 0
    superseded: int = 0
    superseded_bytes: int = 0


@dataclass(slots=True)
class Pinned:
    """What the largest segments come to; ``unknown`` ones are mapped by nobody who told.

    ``shares`` goes by the slots of the sessions that map anything.
    """

    pinned_bytes: int = 0
    unknown: int = 0
    unknown_bytes: int = 0
    shares: dict[int, Share] = field(default_factory=dict)


Answer = Callable[[Pinned], None]


class PinSurvey:
    """Looks at all segments, a few per `step`."""

    def __init__(self, reclaimer: Reclaimer, *, in_service: Callable[[Resident], bool]) -> None:
        self._reclaimer = reclaimer
        self._in_service = in_service
        self._asked: list[tuple[Session, Answer]] = []
        self._running: list[tuple[Session, Answer]] = []
        self._left: list[Resident] = []
        self._found = Pinned()
        self._rests_until_s = 0.0
        self._asking_s = 0.0

    @property
    def idle(self) -> bool:
        """Whether there is nothing to do."""
        return not (self._asked or self._running)

    @property
    def next_step_s(self) -> float:
        """When `turn` has something to do: infinity for never."""
        return float("inf") if self.idle else self._rests_until_s

    def ask(self, session: Session, answer: Answer) -> None:
        """Have ``answer`` called with the result of a survey that begins after now.

        Raises
        ------
        Busy
            The session waits for too many already.
        """
        if sum(asker is session for asker, _ in self._asked) >= MOST_ASKED:
            raise Busy("this session waits for too many answers of this kind", hint="wait for them first")
        self._asked.append((session, answer))

    def turn(self, now_s: float) -> None:
        """Do a step, unless the one before took so long that others come first."""
        if self.idle or now_s < self._rests_until_s:
            return
        self.step()
        took_s = time.monotonic() - now_s
        self._rests_until_s = now_s + took_s / SHARE if took_s > LONG_STEP_S else 0.0

    def step(self) -> None:
        """Look at a few segments, or hand the result to one who asked."""
        if self._left:
            self._look()
        elif self._running:
            _, answer = self._running.pop()
            answer(self._found)
        elif self._asked:
            self._running, self._asked = self._asked[::-1], []
            self._left = self._reclaimer.everything()[:MOST_SEGMENTS]
            self._found = Pinned()
            self._asking_s = 0.0
            self._look()

    def _slots_of(self, resident: Resident) -> list[int]:
        """Who has a segment locked, as far as there is time to ask: else its pin counts as unknown."""
        if self._asking_s > ASKING_S:
            return []
        begin_s = time.thread_time()
        slots = self._reclaimer.slots_of(resident) or []
        self._asking_s += time.thread_time() - begin_s
        return slots

    def _look(self) -> None:
        found, end_s = self._found, time.thread_time() + STEP_S
        for _ in range(min(LOOKS_AT_ONCE, len(self._left))):
            if time.thread_time() > end_s:
                break  # somebody holds very many locks
            resident = self._left.pop()
            users = self._reclaimer.users_among(resident, self._slots_of(resident))
            if users:
                found.pinned_bytes += resident.nbytes
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

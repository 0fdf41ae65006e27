# SPDX-License-Identifier: Apache-2.0
"""Which processes map which segments, and how much memory: the kernel is queried in bounded steps.

A query for one segment takes about 30 us, and there may be thousands of segments.  A continuous walk over all
of them, one step per beat, keeps the gauges of the statistics up to date.  When a session asks, a new walk
begins and runs one step in every turn of the loop; all sessions that asked before it began get its result.
Before a request is refused for its session's quota, some of what that session maps is looked up.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Final

from shmmap.daemon.cache.reclaimer import Reclaimer
from shmmap.daemon.pins.probe import PinSource
from shmmap.daemon.records import Key, Resident
from shmmap.daemon.transport.sessions import Session
from shmmap.daemon.turns import Walk
from shmmap.errors import Busy
from shmmap.protocol.messages import Holder
from shmmap.segment.pins import LOADER_SLOT, has_slot, holders

HOLDERS_S: Final = 0.003
"""Limit of processor time for finding holders for one reply."""
MAX_HOLDING_SEGMENTS: Final = 256
"""Segments queried for one reply, the largest."""
MAX_LOOKS: Final = 128
"""Segments of a session that are checked before one request is refused for its quota."""
UNKNOWN_SLOT: Final = 0
"""Stands for processes that use a segment without having a session."""
ASKING_S: Final = 0.2
"""Limit of processor time for finding the holders in one walk; 2048 segments take 0.03 s."""
LONG_STEP_S: Final = 0.003
SHARE: Final = 0.1
"""Share of the loop's time for steps that take long (when a process holds very many locks)."""
MAX_SEGMENTS: Final = 2048
"""Limit of a walk that a session waits for (largest first)."""
MAX_ASKED: Final = 16
"""Results that one session may wait for at a time."""


@dataclass(eq=False, slots=True)
class Holders:
    """Finds the processes that have segments locked, and their sessions."""

    reclaimer: Reclaimer

    @property
    def by_slot(self) -> bool:
        """Whether the kernel reports which sessions use a segment."""
        return self.reclaimer.pins.source is not PinSource.SESSIONS

    def slots_of(self, resident: Resident) -> list[int] | None:
        """Return the slots that have a segment locked; None if the segment's name is gone."""
        try:
            with self.reclaimer.pins.opened(self.reclaimer.name_on_disk(resident)) as fd:
                return holders(fd)
        except OSError:
            return None

    def has(self, resident: Resident, slot: int) -> bool:
        """Whether a session may have a segment locked: not if the segment exists without its lock."""
        try:
            with self.reclaimer.pins.opened(self.reclaimer.name_on_disk(resident)) as fd:
                return has_slot(fd, slot)
        except OSError:
            return True

    def users_among(self, resident: Resident, slots: Sequence[int]) -> list[int]:
        """Return the given slots that have a segment locked, and 0 for unknown users.

        A user is unknown if its lock belongs to no session (a client of a previous run that has not said
        hello again), or if the segment is pinned without any lock.  Loaders open segments, too, and do not
        count.
        """
        known = [slot for slot in slots if self.reclaimer.sessions.slots.get(slot) is not None]
        ours = slots.count(LOADER_SLOT)
        if len(slots) > len(known) + ours or (not known and not ours and self.reclaimer.is_pinned(resident)):
            known.append(UNKNOWN_SLOT)
        return known

    def of(self, resident: Resident) -> tuple[Holder, ...]:
        """Return the holders of a segment; session 0 is "unknown": a pin without a lock of shmmap."""
        return tuple(self._as_holders({slot: [resident.nbytes, 1] for slot in self._users_of(resident)}))

    def largest(self, most: int) -> tuple[Holder, ...]:
        """Return the holders of most memory, largest first, as far as the largest segments show them."""
        end_s, sums_of = time.thread_time() + HOLDERS_S, dict[int, list[int]]()
        for resident in islice(self.reclaimer.ledger.segments.walk(), MAX_HOLDING_SEGMENTS):
            for slot in self._users_of(resident):
                sums = sums_of.setdefault(slot, [0, 0])
                sums[0] += resident.nbytes
                sums[1] += 1
            if time.thread_time() > end_s:
                break
        return tuple(self._as_holders(sums_of)[:most])

    def _users_of(self, resident: Resident) -> list[int]:
        return self.users_among(resident, self.slots_of(resident) or ())

    def _as_holders(self, found: Mapping[int, Sequence[int]]) -> list[Holder]:
        """Convert bytes and segments by slot into rows of a reply."""
        lines = []
        for slot, (nbytes, cells) in sorted(found.items(), key=lambda item: -item[1][0]):
            session = self.reclaimer.sessions.slots.get(slot)
            if session is None:
                lines.append(Holder(0, 0, -1, "unknown", nbytes, cells))
            else:
                lines.append(session.as_holder(nbytes, cells))
        return lines


@dataclass(slots=True)
class Share:
    """Segments that one session maps; ``superseded`` ones are out of service or have a successor."""

    mapped_bytes: int = 0
    superseded: int = 0
    superseded_bytes: int = 0


@dataclass(slots=True)
class Usage:
    """Number and bytes of mapped segments; ``unknown`` ones are mapped without a session's lock.

    ``shares`` contains the slots of sessions that map segments; it is empty unless the kernel reports
    sessions (``by_slot``).
    """

    count: int = 0
    nbytes: int = 0
    unknown: int = 0
    unknown_bytes: int = 0
    shares: dict[int, Share] = field(default_factory=dict)
    by_slot: bool = True


Answer = Callable[[Usage], None]


class Survey:
    """Walks over all segments to find their users, some segments per `step`.

    Parameters
    ----------
    in_service
        Whether a segment can be handed out.

    Attributes
    ----------
    usage : Usage
        The result of the last complete walk.
    """

    def __init__(self, holders: Holders, *, in_service: Callable[[Resident], bool]) -> None:
        self._holders = holders
        self._segments = holders.reclaimer.ledger.segments
        self._in_service = in_service
        self._asked: list[tuple[Session, Answer]] = []
        self._running: list[tuple[Session, Answer]] = []
        self._walk: Walk[Resident] | None = None
        self.usage = self._found = Usage()
        self._rests_until_s = 0.0
        self._asking_s = 0.0

    @property
    def idle(self) -> bool:
        """Whether no session waits for a result."""
        return not (self._asked or self._running)

    @property
    def next_s(self) -> float:
        """When `run_step` has something to do; infinity for never."""
        return float("inf") if self.idle else self._rests_until_s

    def ask(self, session: Session, answer: Answer) -> None:
        """Call ``answer`` later with the result of a walk that begins after this call.

        Raises
        ------
        Busy
            The session waits for too many results already.
        """
        if sum(asker is session for asker, _ in self._asked) >= MAX_ASKED:
            raise Busy("this session waits for too many answers of this kind", hint="wait for them first")
        self._asked.append((session, answer))

    def run_step(self, now_s: float) -> None:
        """Run a step if a session waits, unless the previous step took so long that other work goes first."""
        if self.idle or now_s < self._rests_until_s:
            return
        self.step()
        took_s = time.monotonic() - now_s
        self._rests_until_s = now_s + took_s / SHARE if took_s > LONG_STEP_S else 0.0

    def look_at(
        self, session: Session, before_s: float, enough: Callable[[], bool], wanted: Container[Key]
    ) -> None:
        """Drop segments that a session no longer maps, until ``enough()``; a bounded number is checked.

        The next call begins with others.  Segments handed out at ``before_s`` or later stay, since the
        session may be about to open them; ``wanted`` keys stay in any case.
        """
        if not self._holders.by_slot:
            return
        end_s = time.thread_time() + HOLDERS_S
        for version in list(islice(session.held, MAX_LOOKS)):  # those checked longest ago
            if enough() or time.thread_time() > end_s:
                return
            for resident in list(session.held[version]):
                is_wanted = resident.key in wanted or resident.last_use_s >= before_s
                if not is_wanted and not self._holders.has(resident, session.slot):
                    session.drop_segment(resident)
            if version in session.held:
                session.held[version] = session.held.pop(version)

    def step(self) -> None:
        """Query some segments, or pass the result to one session that asked."""
        if self._asked and not self._running:
            self._running, self._asked = self._asked[::-1], []
            self._begin(MAX_SEGMENTS)
        elif self._running and self._walk is None:
            _, answer = self._running.pop()
            answer(self.usage)
            return
        walk = self._walk or self._begin(None)
        for resident in walk.for_a_step():
            self._look_at(resident)
        if walk.is_done:
            self._walk, self.usage = None, self._found

    def _begin(self, most: int | None) -> Walk[Resident]:
        self._walk = Walk(islice(self._segments.walk(), most))
        self._found = Usage(by_slot=self._holders.by_slot)
        self._asking_s = 0.0
        return self._walk

    def _slots_of(self, resident: Resident) -> list[int]:
        """Return the slots that have a segment locked; none if time is up: its pin is then unknown."""
        if self._asking_s > ASKING_S:
            return []
        begin_s = time.thread_time()
        slots = self._holders.slots_of(resident) or []
        self._asking_s += time.thread_time() - begin_s
        return slots

    def _look_at(self, resident: Resident) -> None:
        found = self._found
        users = self._holders.users_among(resident, self._slots_of(resident))
        if users:
            found.count += 1
            found.nbytes += resident.nbytes
        for slot in users:
            if slot == UNKNOWN_SLOT:
                found.unknown += 1
                found.unknown_bytes += resident.nbytes
                continue
            share = found.shares.setdefault(slot, Share())
            share.mapped_bytes += resident.nbytes
            if not self._in_service(resident):
                share.superseded += 1
                share.superseded_bytes += resident.nbytes

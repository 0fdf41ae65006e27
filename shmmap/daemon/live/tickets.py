# SPDX-License-Identifier: Apache-2.0
"""Who waits for which answer of the live worker: bounded for a session, for a process, and in all."""

from __future__ import annotations

from collections import Counter, deque
from typing import Final

from shmmap.daemon.live.messages import MOST_OF_A_SESSION
from shmmap.daemon.transport.sessions import Session
from shmmap.errors import Busy, LiveInterrupted

__all__ = ["Tickets"]

MOST_OF_A_PROCESS: Final = 256
MOST_WAITING: Final = 4096
"""Requests of one process, and of all, that wait for their answers."""
REFUSED_AT_ONCE: Final = 64
"""Requests that one turn of the loop refuses, after a worker has ended."""


class Tickets:
    """Requests that were passed on and are not answered."""

    def __init__(self) -> None:
        self._asked: dict[int, tuple[Session, int]] = {}
        self._of: dict[int, set[int]] = {}  # by session
        self._waiting: Counter[int] = Counter()  # by process
        self._lost: deque[tuple[Session, int]] = deque()
        self._last = 0

    def __len__(self) -> int:
        return len(self._asked) + len(self._lost)

    def give(self, session: Session, request: int) -> int:
        """A session asks something; raises Busy if too much waits."""
        for whose, waiting, most in (
            ("this session", len(self._of.get(session.slot, ())), MOST_OF_A_SESSION),
            ("this process", self._waiting[session.asker], MOST_OF_A_PROCESS),
            ("all sessions", len(self), MOST_WAITING),
        ):
            if waiting >= most:
                raise Busy(f"{waiting} requests of {whose} about live maps wait", hint="wait for some")
        self._last += 1
        self._asked[self._last] = session, request
        self._of.setdefault(session.slot, set()).add(self._last)
        self._waiting[session.asker] += 1
        return self._last

    def take(self, ticket: int) -> Session | None:
        """Who is to have an answer; nobody, if the session has ended."""
        session, _ = self._asked.pop(ticket, (None, 0))
        if session is not None:
            self._of[session.slot].discard(ticket)
            self._waiting[session.asker] -= 1
            if not self._of[session.slot]:
                del self._of[session.slot]
            if not self._waiting[session.asker]:
                del self._waiting[session.asker]
        return session

    def left(self, session: Session) -> None:
        """A session has ended."""
        for ticket in list(self._of.get(session.slot, ())):
            self.take(ticket)
        if self._lost:
            self._lost = deque(row for row in self._lost if row[0] is not session)

    def lose(self) -> None:
        """The worker has ended: nothing of all this is answered; `refuse_some` tells who waits."""
        self._lost += self._asked.values()
        self._asked = {}
        self._of.clear()
        self._waiting.clear()

    @property
    def are_lost(self) -> bool:
        """Whether somebody is to be told."""
        return bool(self._lost)

    def refuse_some(self) -> None:
        """Tell some of those whose worker has ended."""
        error = LiveInterrupted("the process that keeps live maps ended, and is started anew")
        for _ in range(min(REFUSED_AT_ONCE, len(self._lost))):
            session, request = self._lost.popleft()
            session.connection.refuse(request, error)

# SPDX-License-Identifier: Apache-2.0
"""Requests that wait for loads: whose patience ends next, and whether a session has too many."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterator
from typing import Final, Generic, Protocol, TypeVar

from shmmap.daemon.transport.sessions import Session

__all__ = ["MOST_OF_A_SESSION", "WaitingList"]

MOST_OF_A_SESSION: Final = 64
"""Requests of one session that may wait; further ones are answered at once, what is cold is pending."""


class _Request(Protocol):
    """What the list needs to know of a request."""

    session: Session
    deadline_s: float


Waiting = TypeVar("Waiting", bound=_Request)


class WaitingList(Generic[Waiting]):
    """Requests in order of their deadlines; adding and removing one costs the same however many wait."""

    def __init__(self) -> None:
        self._requests: dict[Waiting, None] = {}
        self._heap: list[tuple[float, int, Waiting]] = []
        self._counts: Counter[Session] = Counter()
        self._number = 0

    def __len__(self) -> int:
        return len(self._requests)

    def __iter__(self) -> Iterator[Waiting]:
        return iter(list(self._requests))

    def has_room(self, session: Session) -> bool:
        """Whether one more request of the session may wait."""
        return self._counts[session] < MOST_OF_A_SESSION

    def add(self, request: Waiting) -> None:
        """A request waits until its ``deadline_s``, which does not change any more."""
        self._number += 1
        self._requests[request] = None
        self._counts[request.session] += 1
        heapq.heappush(self._heap, (request.deadline_s, self._number, request))

    def remove(self, request: Waiting) -> None:
        """A request waits no longer."""
        del self._requests[request]
        self._counts[request.session] -= 1
        if not self._counts[request.session]:
            del self._counts[request.session]
        if len(self._heap) > 2 * len(self._requests) + 64:
            self._heap = [entry for entry in self._heap if entry[2] in self._requests]
            heapq.heapify(self._heap)

    def next_deadline_s(self) -> float:
        """When the next one's patience ends; infinity when none waits."""
        while self._heap and self._heap[0][2] not in self._requests:
            heapq.heappop(self._heap)
        return self._heap[0][0] if self._heap else float("inf")

    def overdue(self, now_s: float) -> list[Waiting]:
        """Those whose patience has ended."""
        if self.next_deadline_s() > now_s:
            return []
        return [request for request in self._requests if request.deadline_s <= now_s]

    def of(self, session: Session) -> list[Waiting]:
        """Those of one session."""
        if session not in self._counts:
            return []
        return [request for request in self._requests if request.session is session]

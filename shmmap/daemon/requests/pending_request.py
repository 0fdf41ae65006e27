# SPDX-License-Identifier: Apache-2.0
"""Requests for cells that are not answered yet: what each asks for, and whose patience ends next."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap.daemon.records import Key
from shmmap.daemon.transport.sessions import Session
from shmmap.geometry import Area, distance_to_boxes

__all__ = ["MOST_OF_A_SESSION", "PendingRequest", "WaitingList"]

MOST_OF_A_SESSION: Final = 64
"""Requests of one session that may wait; further ones are answered at once, what is cold is pending."""

OVERDUE_AT_ONCE: Final = 256


@dataclass(eq=False, slots=True)
class PendingRequest:
    """What one request asks for, and what of it is still outstanding.

    Attributes
    ----------
    cells
        Catalogue index and layer of each handle to send, in reply order.
    removed, removed_packed
        What the client should drop, as the reply says it.
    unknown
        Ids that the map does not have, with the layers asked for.
    refused
        What would exceed the session's quota, with code and message.
    held_old
        Ids of cells that the client holds in an older version.
    area
        What was asked about; None for a request by ids.
    keys, outstanding
        What it waits for in all, and the loads of it that have not ended.
    began_s, deadline_s
        When it began to wait and until when; 0 for a request that does not wait.
    due
        Whether it will be answered in its process's next turn.
    """

    session: Session
    request: int
    cells: list[tuple[int, str]]
    removed: tuple[str, ...] = ()
    removed_packed: bytes = b""
    unknown: list[tuple[str, str]] = field(default_factory=list)
    refused: dict[Key, tuple[str, str]] = field(default_factory=dict)
    held_old: set[str] = field(default_factory=set)
    area: Area | None = None
    keys: tuple[Key, ...] = ()
    outstanding: set[Key] = field(default_factory=set)
    began_s: float = 0.0
    deadline_s: float = 0.0
    due: bool = False

    def distances_m(self, boxes: NDArray[np.float64]) -> NDArray[np.float64]:
        """How far boxes, (N, 4), are from the client, as far as it said where it is.

        Else from the middle of what it asks about; 0 for a request by ids.
        """
        intent = self.session.intent
        if intent is not None:
            return distance_to_boxes(intent.x, intent.y, boxes)
        if self.area is not None:
            return distance_to_boxes(*self.area.center, boxes)
        return np.zeros(len(boxes))


class WaitingList:
    """Requests that wait for loads, in order of their deadlines.

    Adding and removing one costs the same however many wait.
    """

    def __init__(self) -> None:
        self._requests: dict[PendingRequest, None] = {}
        self._heap: list[tuple[float, int, PendingRequest]] = []
        self._counts: Counter[Session] = Counter()
        self._number = 0

    def __len__(self) -> int:
        return len(self._requests)

    def __iter__(self) -> Iterator[PendingRequest]:
        return iter(list(self._requests))

    def has_room(self, session: Session) -> bool:
        """Whether one more request of the session may wait."""
        return self._counts[session] < MOST_OF_A_SESSION

    def add(self, request: PendingRequest) -> None:
        """A request waits until its ``deadline_s``, which does not change any more."""
        self._number += 1
        self._requests[request] = None
        self._counts[request.session] += 1
        heapq.heappush(self._heap, (request.deadline_s, self._number, request))

    def __contains__(self, request: PendingRequest) -> bool:
        return request in self._requests

    def remove(self, request: PendingRequest) -> None:
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
        while self._heap and not self._waits(self._heap[0][2]):
            heapq.heappop(self._heap)
        return self._heap[0][0] if self._heap else float("inf")

    def overdue(self, now_s: float) -> list[PendingRequest]:
        """Those whose patience has ended, a bounded number at a time."""
        found: list[PendingRequest] = []
        while self.next_deadline_s() <= now_s and len(found) < OVERDUE_AT_ONCE:
            found.append(heapq.heappop(self._heap)[2])
        return found

    def _waits(self, request: PendingRequest) -> bool:
        return request in self._requests and not request.due

    def of(self, session: Session) -> list[PendingRequest]:
        """Those of one session."""
        if session not in self._counts:
            return []
        return [request for request in self._requests if request.session is session]

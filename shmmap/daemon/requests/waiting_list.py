# SPDX-License-Identifier: Apache-2.0
"""Requests for cells that wait for loads or pages of the map, the cells they need, and their deadlines."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from typing import Final, TypeAlias, TypeVar

from shmmap.daemon.cache.ledger import Ledger
from shmmap.daemon.records import Key
from shmmap.daemon.transport.sessions import Session
from shmmap.geometry import Area
from shmmap.protocol import messages

MAX_OF_A_SESSION: Final = 64
"""Requests of one session that may wait; further ones are answered at once, with cold cells as pending."""
MAX_REQUESTS: Final = 16_384
MAX_WEIGHT_OF_A_PROCESS: Final = 20_000
MAX_WEIGHT: Final = 200_000
"""Weight of all waiting requests, 250 bytes each; beyond it, requests are answered at once."""
PACKED_PER_CELL: Final = 256
HELD_PER_CELL: Final = 2
"""Bytes of packed versions, and cells held by name, that weigh as much as one requested cell."""
TAKEN_PER_TURN: Final = 256

Message: TypeAlias = messages.Area | messages.Differential | messages.Selected
Awaited = TypeVar("Awaited")


@dataclass(eq=False, slots=True)
class CellRequest:
    """A request for cells that is not answered yet; each attempt to answer it begins with its message.

    Attributes
    ----------
    layers
        Requested layers, without duplicates.
    area
        Requested area; None for a request by ids.
    began_s, deadline_s
        When it came, and until when it may wait.
    attempts
        Attempts that did not answer it; those after which a page of the map came do not count.
    needed, outstanding, pages
        Cells protected from eviction for the request, and the loads and pages it waits for.
    refused
        Cells that exceeded the session's quota.
    weight
        Memory that it takes while it waits, in cells.
    is_due
        Whether an attempt to answer it is queued.
    """

    session: Session
    message: Message
    layers: tuple[str, ...]
    area: Area | None
    began_s: float
    deadline_s: float
    attempts: int = 0
    needed: set[Key] = field(default_factory=set)
    outstanding: set[Key] = field(default_factory=set)
    pages: set[int] = field(default_factory=set)
    refused: set[Key] = field(default_factory=set)
    weight: int = 0
    is_due: bool = False

    @property
    def is_spare(self) -> bool:
        """Whether it may cost other clients nothing; see `shmmap.protocol.messages.Selected`."""
        return isinstance(self.message, messages.Selected) and self.message.spare

    def weigh(self, cells: int) -> None:
        """Set the weight of a request for this many cells."""
        held = 0
        if isinstance(self.message, messages.Differential):
            held = len(self.message.packed) // PACKED_PER_CELL + len(self.message.held) // HELD_PER_CELL
        self.weight = max(cells, held)


class WaitingList:
    """Requests that wait; adding or removing one costs the same however many wait.

    Parameters
    ----------
    ledger
        Protects needed cells from eviction.
    """

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger
        self._of_load: dict[Key, dict[CellRequest, None]] = {}
        self._of_page: dict[int, dict[CellRequest, None]] = {}
        self._of: dict[Session, dict[CellRequest, None]] = {}
        self._due: dict[CellRequest, None] = {}
        self._heap: list[tuple[float, int, CellRequest]] = []
        self._weights: Counter[int] = Counter()
        self._count = self._weight = 0
        self._number = 0

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[CellRequest]:
        return iter([request for requests in self._of.values() for request in requests])

    def __contains__(self, request: CellRequest) -> bool:
        return request in self._of.get(request.session, ())

    def of(self, session: Session) -> list[CellRequest]:
        """Return the waiting requests of one session."""
        return list(self._of.get(session, ()))

    def has_room(self, request: CellRequest) -> bool:
        """Whether a request may wait; one that waits already may wait again."""
        weight, asker = request.weight, request.session.asker
        return request in self or (
            self._count < MAX_REQUESTS
            and len(self._of.get(request.session, ())) < MAX_OF_A_SESSION
            and self._weights[asker] + weight <= MAX_WEIGHT_OF_A_PROCESS
            and self._weight + weight <= MAX_WEIGHT
        )

    def wait(
        self, request: CellRequest, needed: set[Key], outstanding: Collection[Key], pages: Collection[int]
    ) -> None:
        """Let a request wait, for the first time or again; its ``deadline_s`` must not change afterwards."""
        if request not in self:
            self._of.setdefault(request.session, {})[request] = None
            self._count += 1
            self._weight += request.weight
            self._weights[request.session.asker] += request.weight
        for key in needed - request.needed:
            self._ledger.need(key)
        for key in request.needed - needed:
            self._ledger.need_no_more(key)
        request.needed = needed
        _wait_for(self._of_load, request.outstanding, outstanding, request)
        _wait_for(self._of_page, request.pages, pages, request)
        request.is_due = False
        self._number += 1
        heapq.heappush(self._heap, (request.deadline_s, self._number, request))

    def remove(self, request: CellRequest) -> None:
        """Remove a request from the list; `release` what it needed, now or later."""
        session, asker = request.session, request.session.asker
        del self._of[session][request]
        if not self._of[session]:
            del self._of[session]
        self._due.pop(request, None)
        self._count -= 1
        self._weight -= request.weight
        self._weights[asker] -= request.weight
        if not self._weights[asker]:
            del self._weights[asker]
        if len(self._heap) > 2 * self._count + 64:
            self._heap = [entry for entry in self._heap if entry[2] in self]
            heapq.heapify(self._heap)

    def release(self, request: CellRequest) -> None:
        """Release the cells that a removed request needed, and let it wait for nothing."""
        for key in request.needed:
            self._ledger.need_no_more(key)
        request.needed = set()
        _wait_for(self._of_load, request.outstanding, (), request)
        _wait_for(self._of_page, request.pages, (), request)

    # --- what is due ----------------------------------------------------------------------------

    def load_finished(self, key: Key) -> None:
        """Note the end of a load, successful or not, for the requests that wait for it."""
        for request in self._of_load.pop(key, ()):
            request.outstanding.discard(key)
            if not request.outstanding and not request.pages:
                self._set_due(request)

    def page_finished(self, page: int) -> None:
        """Have the requests that wait for a page tried again: it has arrived, or cannot be fetched."""
        for request in self._of_page.pop(page, ()):
            request.pages.discard(page)
            if not request.is_due:
                request.attempts -= 1
            self._set_due(request)

    def map_changed(self) -> None:
        """Have the requests that wait for pages tried again: the map has other pages now."""
        waiting, self._of_page = self._of_page, {}
        for requests in waiting.values():
            for request in requests:
                request.pages.clear()
                self._set_due(request)

    def _set_due(self, request: CellRequest) -> None:
        if not request.is_due and request in self:
            request.is_due = True
            self._due[request] = None

    def take(self, now_s: float) -> list[CellRequest]:
        """Take requests that have nothing left to wait for, or whose time is over; a bounded number."""
        while self._first_deadline_s() <= now_s and len(self._due) < TAKEN_PER_TURN:
            self._set_due(heapq.heappop(self._heap)[2])
        taken = list(self._due)[:TAKEN_PER_TURN]
        for request in taken:
            del self._due[request]
        return taken

    def next_s(self) -> float:
        """Return when `take` has something to return: now, or at the earliest deadline; else infinity."""
        return 0.0 if self._due else self._first_deadline_s()

    def _first_deadline_s(self) -> float:
        while self._heap and (self._heap[0][2].is_due or self._heap[0][2] not in self):
            heapq.heappop(self._heap)
        return self._heap[0][0] if self._heap else float("inf")


def _wait_for(
    waiting: dict[Awaited, dict[CellRequest, None]],
    mine: set[Awaited],
    now: Collection[Awaited],
    request: CellRequest,
) -> None:
    """Let a request wait for what is in ``now``, and no longer for the rest of ``mine``, its own record."""
    for what in mine.difference(now):
        left = waiting.get(what, {})
        left.pop(request, None)
        if not left:
            waiting.pop(what, None)
    for what in now:
        waiting.setdefault(what, {})[request] = None
    mine.clear()
    mine.update(now)

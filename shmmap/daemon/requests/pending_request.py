# SPDX-License-Identifier: Apache-2.0
"""Requests for cells that are not answered yet: what each asks for, waits for, and its deadline.

A request may name very many cells.  Work on them ends its turn when the turn's time is used up
(`PendingRequest.pause`).
"""

from __future__ import annotations

import heapq
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Final, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.cache.ledger import Ledger
from shmmap.daemon.map.catalogue_view import CatalogueView
from shmmap.daemon.records import Key
from shmmap.daemon.transport.sessions import Session
from shmmap.daemon.turns import Pace, Walk
from shmmap.errors import NoSession
from shmmap.geometry import Area, distance_to_boxes

MAX_OF_A_SESSION: Final = 64
"""Requests of one session that may wait; further ones are answered at once, with cold cells as pending."""
MAX_REQUESTS: Final = 16_384
MAX_CELLS_OF_A_PROCESS: Final = 20_000
MAX_CELLS: Final = 200_000
"""Cells of all waiting requests, 250 bytes each; beyond this number, requests are answered at once."""
OVERDUE_PER_TURN: Final = 256
LARGE: Final = 1024
"""A request for more cells is large: a step that handles all of them at once gets its own turn."""

Awaited = TypeVar("Awaited")


class MapChanged(Exception):
    """The catalogue indices of a request have become invalid."""


@dataclass(eq=False, slots=True)
class Found:
    """Cells found for a request in one state of the map.

    Attributes
    ----------
    cells
        Catalogue index and layer of each handle to send, in reply order.
    covered, reason
        Whether all cells of the requested area are known; if not, why the request does not wait for the rest.
    pages
        Pages of the map that may list more cells of the request.
    removed, removed_packed
        Cells that the client should drop, as the reply encodes them.
    unknown
        Ids that the map does not contain, with the requested layers.
    held_old
        Layers of cells that the client holds in an outdated version.
    refused
        Cells that exceed the session's quota.
    requested
        Whether loads of the cold cells have been requested.
    """

    catalogue: CatalogueView | None = None
    cells: list[tuple[int, str]] = field(default_factory=list)
    covered: bool = True
    reason: str = ""
    pages: set[int] = field(default_factory=set)
    removed: tuple[str, ...] = ()
    removed_packed: bytes = b""
    unknown: list[tuple[str, str]] = field(default_factory=list)
    held_old: set[Key] = field(default_factory=set)
    refused: set[Key] = field(default_factory=set)
    requested: bool = False


Finder: TypeAlias = Callable[["PendingRequest"], Iterator[None]]
"""Finds a request's cells in the map that is served now, and writes them to its `Found`."""


@dataclass(eq=False, slots=True)
class PendingRequest:
    """A request that is not answered yet.

    Its cells are found before it is answered, and found again when another state of the map is served, or
    when a page that it waits for has arrived.

    Attributes
    ----------
    layers
        Requested layers of each cell, as the reply names them.
    area
        Requested area; None for a request by ids.
    message_cells
        Memory of the request's message, in cells.
    spare
        Whether it may cost other clients nothing; see `shmmap.protocol.messages.Selected`.
    needed, outstanding
        Cells protected from eviction for the request, and the loads it waits for.
    began_s, deadline_s
        When it began to wait, and its deadline; 0 for a request that does not wait.
    outdated
        Whether its cells have to be found again.
    """

    cache: CellCache
    session: Session
    request: int
    layers: tuple[str, ...]
    find: Finder
    area: Area | None = None
    message_cells: int = 0
    spare: bool = False
    found: Found = field(default_factory=Found)
    needed: dict[Key, None] = field(default_factory=dict)
    outstanding: set[Key] = field(default_factory=set)
    began_s: float = 0.0
    deadline_s: float = 0.0
    outdated: bool = False
    pace: Pace = field(default_factory=Pace)

    def find_again(self) -> Iterator[None]:
        """Find the request's cells in the map that is served now, unless they were found in that one.

        Raises
        ------
        MapChanged, NoSession
            See `pause`.
        BadRequest
            The request names too many cells.
        """
        if self.outdated or self.found.catalogue is not self.cache.catalogue:
            self.found, self.outdated = Found(self.cache.catalogue), False
            yield from self.find(self)

    def pause(self, *, now: bool = False) -> Iterator[None]:
        """End the turn if its time is used up, or with ``now`` in any case: before a long step.

        Raises
        ------
        MapChanged
            Another state of the map is served now: the cells have to be found again.
        NoSession
            The session has ended.
        """
        if now or self.pace.is_over:
            yield
            self.pace.begin()
            if not self.session.is_connected:
                raise NoSession("the session ended before the answer was ready", hint="send hello again")
            if self.cache.catalogue is not self.found.catalogue:
                raise MapChanged

    @property
    def is_large(self) -> bool:
        """Whether a step over all its cells at once deserves a turn of its own."""
        return len(self.found.cells) > LARGE

    @property
    def weight(self) -> int:
        """Memory of the request, in cells."""
        return max(len(self.found.cells), self.message_cells)

    @property
    def waits(self) -> bool:
        """Whether a load or page that it waits for has neither arrived nor failed."""
        return bool(self.outstanding or self.found.pages)

    def distances_m(self, cells: Iterable[tuple[int, str]]) -> list[float]:
        """Return the distances of cells from the position that the client sent.

        Without one, from the centre of the requested area; 0 for a request by ids.
        """
        boxes = self.cache.catalogue.boxes_of(np.array([index for index, _ in cells], dtype=np.intp))
        intent = self.session.intent
        distances: NDArray[np.float64]
        if intent is not None:
            distances = distance_to_boxes(intent.x, intent.y, boxes)
        elif self.area is not None:
            distances = distance_to_boxes(*self.area.center, boxes)
        else:
            return [0.0] * len(boxes)
        return list(distances.tolist())


class WaitingList:
    """Requests that wait for loads or pages, the cells they need, and their deadlines in order.

    Adding or removing a request costs the same however many wait.  `tidy` does the work that follows from the
    end of a load, a request or a session, in bounded steps.

    Parameters
    ----------
    ledger
        Protects needed cells from eviction.
    """

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger
        self._of_load: dict[Key, dict[PendingRequest, None]] = {}
        self._of_page: dict[int, dict[PendingRequest, None]] = {}
        self._of: dict[Session, dict[PendingRequest, int]] = {}  # with the weight counted for each, in cells
        self._taken: set[PendingRequest] = set()
        self._heap: list[tuple[float, int, PendingRequest]] = []
        self._cells: Counter[int] = Counter()
        self._count = self._all_cells = 0
        self._number = 0
        self._news: deque[Iterator[PendingRequest | None]] = deque()
        self._leftovers: deque[Iterator[PendingRequest | None]] = deque()

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[PendingRequest]:
        return iter([request for requests in self._of.values() for request in requests])

    def __contains__(self, request: PendingRequest) -> bool:
        return request in self._of.get(request.session, ())

    def of(self, session: Session) -> list[PendingRequest]:
        """Return the waiting requests of one session."""
        return list(self._of.get(session, ()))

    def has_room(self, request: PendingRequest) -> bool:
        """Whether a request may wait."""
        count, asker = request.weight, request.session.asker
        return (
            self._count < MAX_REQUESTS
            and len(self._of.get(request.session, ())) < MAX_OF_A_SESSION
            and self._cells[asker] + count <= MAX_CELLS_OF_A_PROCESS
            and self._all_cells + count <= MAX_CELLS
        )

    def add(self, request: PendingRequest) -> None:
        """Let a request wait until its ``deadline_s``, which must not change afterwards."""
        self._of.setdefault(request.session, {})[request] = 0
        self._count += 1
        self.recount(request)
        self.put_back(request)

    def recount(self, request: PendingRequest) -> bool:
        """Count the cells of a waiting request again; return whether the list is still within its limit."""
        asker, mine = request.session.asker, self._of[request.session]
        more = request.weight - mine[request]
        mine[request] += more
        self._cells[asker] += more
        self._all_cells += more
        return self._cells[asker] <= MAX_CELLS_OF_A_PROCESS and self._all_cells <= MAX_CELLS

    def take(self, request: PendingRequest) -> bool:
        """Take a waiting request to answer it; return False if it was taken before."""
        is_new = request in self and request not in self._taken
        if is_new:
            self._taken.add(request)
        return is_new

    def put_back(self, request: PendingRequest) -> None:
        """Let a request that was taken wait again."""
        self._number += 1
        self._taken.discard(request)
        heapq.heappush(self._heap, (request.deadline_s, self._number, request))

    def remove(self, request: PendingRequest) -> None:
        """Remove a request from the list."""
        session, asker = request.session, request.session.asker
        count = self._of[session].pop(request)
        if not self._of[session]:
            del self._of[session]
        self._taken.discard(request)
        self._count -= 1
        self._all_cells -= count
        self._cells[asker] -= count
        if not self._cells[asker]:
            del self._cells[asker]
        if len(self._heap) > 2 * self._count + 64:
            self._heap = [entry for entry in self._heap if entry[2] in self]
            heapq.heapify(self._heap)

    def next_deadline_s(self) -> float:
        """Return the time of the next work: now, or the earliest deadline; else infinity."""
        return 0.0 if self._news or self._leftovers else self._first_deadline_s()

    def _first_deadline_s(self) -> float:
        while self._heap and not self._waits(self._heap[0][2]):
            heapq.heappop(self._heap)
        return self._heap[0][0] if self._heap else float("inf")

    def _waits(self, request: PendingRequest) -> bool:
        return request in self and request not in self._taken

    def overdue(self, now_s: float) -> list[PendingRequest]:
        """Return requests whose deadline has passed, a bounded number."""
        found: list[PendingRequest] = []
        while self._first_deadline_s() <= now_s and len(found) < OVERDUE_PER_TURN:
            found.append(heapq.heappop(self._heap)[2])
        return found

    # --- what they need and wait for ------------------------------------------------------------

    def need(self, wanted: PendingRequest, key: Key) -> None:
        """Protect a requested cell from eviction until the answer has left."""
        if key not in wanted.needed:
            wanted.needed[key] = None
            self._ledger.need(key)

    def wait_for(self, wanted: PendingRequest, key: Key) -> None:
        """Let a request wait for a load."""
        wanted.outstanding.add(key)
        self._of_load.setdefault(key, {})[wanted] = None

    def wait_for_pages(self, wanted: PendingRequest) -> None:
        """Let a request wait for its missing ``pages``."""
        for page in wanted.found.pages:
            self._of_page.setdefault(page, {})[wanted] = None

    # --- what is done little by little ----------------------------------------------------------

    def load_finished(self, key: Key) -> None:
        """Note the end of a load, successful or not, for the requests that wait for it."""

        def note(waiters: Iterable[PendingRequest]) -> Iterator[PendingRequest]:
            for waiter in waiters:
                waiter.outstanding.discard(key)
                yield waiter

        if waiters := self._of_load.pop(key, None):
            self._news.append(note(waiters))

    def page_finished(self, page: int, reason: str = "") -> None:
        """Note that a page has arrived, or why it cannot be fetched, for the requests that wait for it."""

        def note(waiters: Iterable[PendingRequest]) -> Iterator[PendingRequest]:
            for waiter in waiters:
                found = waiter.found
                if page in found.pages:
                    found.pages.discard(page)
                    waiter.outdated = waiter.outdated or not reason
                    found.reason = found.reason or reason
                yield waiter

        if waiters := self._of_page.pop(page, None):
            self._news.append(note(waiters))

    def map_changed(self) -> None:
        """Have requests that wait for pages find their cells again: the map now has other pages."""

        def note(waiters: Iterable[PendingRequest]) -> Iterator[PendingRequest]:
            for waiter in waiters:
                waiter.outdated = True
                yield waiter

        waiting, self._of_page = self._of_page, {}
        self._news.extend(map(note, waiting.values()))

    def release(self, wanted: PendingRequest) -> None:
        """Release the cells that a finished request needed."""

        def steps() -> Iterator[None]:
            while wanted.needed:
                self._ledger.need_no_more(wanted.needed.popitem()[0])
                yield
            while wanted.outstanding:
                _leave(self._of_load, wanted.outstanding.pop(), wanted)
                yield
            while wanted.found.pages:
                _leave(self._of_page, wanted.found.pages.pop(), wanted)
                yield

        if wanted.needed or wanted.waits:
            self.do_later(steps())

    def do_later(self, steps: Iterator[None]) -> None:
        """Queue steps that no client waits for; `tidy` runs them."""
        self._leftovers.append(steps)

    def tidy(self) -> Iterator[PendingRequest]:
        """Run one turn of deferred steps; yield requests that have nothing left to wait for."""
        for one in Walk(self._steps()).for_a_turn():
            if one is not None and (one.outdated or not one.waits) and one in self:
                yield one

    def _steps(self) -> Iterator[PendingRequest | None]:
        """Run the deferred steps, those of waiting requests first; yield after each step."""
        while queue := self._news or self._leftovers:
            step = next(queue[0], self)
            if isinstance(step, WaitingList):  # no step is queued
                queue.popleft()
            else:
                yield step


def _leave(waiting: dict[Awaited, dict[PendingRequest, None]], what: Awaited, wanted: PendingRequest) -> None:
    """Remove a request from those that wait for a load or page."""
    left = waiting.get(what, {})
    left.pop(wanted, None)
    if not left:
        waiting.pop(what, None)

# SPDX-License-Identifier: Apache-2.0
"""Requests for cells that are not answered yet: what each asks for, what it waits for, and until when.

A request may be for very many cells.  What goes through them ends its turn when the turn's time is used
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

__all__ = ["LARGE", "MAX_OF_A_SESSION", "Finder", "Found", "MapChanged", "PendingRequest", "WaitingList"]

MAX_OF_A_SESSION: Final = 64
"""Requests of one session that may wait; further ones are answered at once, what is cold is pending."""
MAX_REQUESTS: Final = 16_384
MAX_CELLS_OF_A_PROCESS: Final = 20_000
MAX_CELLS: Final = 200_000
"""Cells of all requests that wait, a quarter of a kilobyte each; beyond, all are answered at once."""
OVERDUE_PER_TURN: Final = 256
LARGE: Final = 1024
"""More cells than this make a request large: a step that handles all of them gets a turn of its own."""

Awaited = TypeVar("Awaited")


class MapChanged(Exception):
    """Catalogue indices mean other cells now."""


@dataclass(eq=False, slots=True)
class Found:
    """What a request asks for, in one state of the map.

    Attributes
    ----------
    cells
        Catalogue index and layer of each handle to send, in reply order.
    covered, reason
        Whether all cells of what it asks about are known; why that is not to be waited for.
    pages
        Pages of the map that may have more of what it asks about.
    removed, removed_packed
        What the client should drop, as the reply says it.
    unknown
        Ids that the map does not have, with the layers asked for.
    held_old
        Layers of cells that the client holds in an older version.
    refused
        What would exceed the session's quota.
    requested
        Whether loads of what is cold were requested.
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
"""Finds what a request asks for in the map that is served now, and notes it in its `Found`."""


@dataclass(eq=False, slots=True)
class PendingRequest:
    """A request that is not answered yet.

    What it asks for is found before it is answered, and found again when another state of the map is
    served, or when a page has come that it waits for.

    Attributes
    ----------
    layers
        What it asks for of each cell, as the reply says it.
    area
        What it asks about; None for a request by ids.
    message_cells
        Memory that its message takes, counted in cells.
    needed, outstanding
        What is kept from being evicted for it, and the loads it waits for.
    began_s, deadline_s
        When it began to wait and until when; 0 for a request that does not wait.
    outdated
        Whether there is more to find than was found.
    """

    cache: CellCache
    session: Session
    request: int
    layers: tuple[str, ...]
    find: Finder
    area: Area | None = None
    message_cells: int = 0
    found: Found = field(default_factory=Found)
    needed: dict[Key, None] = field(default_factory=dict)
    outstanding: set[Key] = field(default_factory=set)
    began_s: float = 0.0
    deadline_s: float = 0.0
    outdated: bool = False
    pace: Pace = field(default_factory=Pace)

    def find_again(self) -> Iterator[None]:
        """Find what it asks for in the map that is served now, unless that is what was found.

        Raises
        ------
        MapChanged, NoSession
            See `pause`.
        BadRequest
            It asks for too much.
        """
        if self.outdated or self.found.catalogue is not self.cache.catalogue:
            self.found, self.outdated = Found(self.cache.catalogue), False
            yield from self.find(self)

    def pause(self, *, now: bool = False) -> Iterator[None]:
        """End the turn, if it has used its time, or ``now``: before much that is done at once.

        Raises
        ------
        MapChanged
            Meanwhile another state of the map is served: what is asked for has to be found again.
        NoSession
            Meanwhile the session has ended.
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
        """Whether what is done at once for all cells found is worth a turn of its own."""
        return len(self.found.cells) > LARGE

    @property
    def weight(self) -> int:
        """Memory that it takes, in cells."""
        return max(len(self.found.cells), self.message_cells)

    @property
    def waits(self) -> bool:
        """Whether something it waits for has neither come nor failed."""
        return bool(self.outstanding or self.found.pages)

    def distances_m(self, cells: Iterable[tuple[int, str]]) -> list[float]:
        """Return how far cells are from where the client says it is.

        Else from the middle of what it asks about; 0 for a request by ids.
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
    """Requests that wait for loads or pages, what they need, and in which order their time ends.

    Adding and removing one costs the same however many wait.  What follows from the end of a load, a request
    or a session is done in `tidy`, a turn's worth at a time.

    Parameters
    ----------
    ledger
        Keeps from being evicted what is needed.
    """

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger
        self._of_load: dict[Key, dict[PendingRequest, None]] = {}
        self._of_page: dict[int, dict[PendingRequest, None]] = {}
        self._of: dict[Session, dict[PendingRequest, int]] = {}  # with the number of cells it began with
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
        """Return the requests of one session."""
        return list(self._of.get(session, ()))

    def has_room(self, request: PendingRequest) -> bool:
        """Whether this one may wait, too."""
        count, asker = request.weight, request.session.asker
        return (
            self._count < MAX_REQUESTS
            and len(self._of.get(request.session, ())) < MAX_OF_A_SESSION
            and self._cells[asker] + count <= MAX_CELLS_OF_A_PROCESS
            and self._all_cells + count <= MAX_CELLS
        )

    def add(self, request: PendingRequest) -> None:
        """Let a request wait until its ``deadline_s``, which does not change any more."""
        self._of.setdefault(request.session, {})[request] = 0
        self._count += 1
        self.recount(request)
        self.put_back(request)

    def recount(self, request: PendingRequest) -> bool:
        """Count the cells of a waiting request again; whether all may go on waiting."""
        asker, mine = request.session.asker, self._of[request.session]
        more = request.weight - mine[request]
        mine[request] += more
        self._cells[asker] += more
        self._all_cells += more
        return self._cells[asker] <= MAX_CELLS_OF_A_PROCESS and self._all_cells <= MAX_CELLS

    def take(self, request: PendingRequest) -> bool:
        """Take a waiting request to be answered; False if it is taken already."""
        is_new = request in self and request not in self._taken
        if is_new:
            self._taken.add(request)
        return is_new

    def put_back(self, request: PendingRequest) -> None:
        """Let a request that was taken go on waiting."""
        self._number += 1
        self._taken.discard(request)
        heapq.heappush(self._heap, (request.deadline_s, self._number, request))

    def remove(self, request: PendingRequest) -> None:
        """Let a request wait no longer."""
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
        """Return when there is something to do: at once, or when a request's time ends; else infinity."""
        return 0.0 if self._news or self._leftovers else self._first_deadline_s()

    def _first_deadline_s(self) -> float:
        while self._heap and not self._waits(self._heap[0][2]):
            heapq.heappop(self._heap)
        return self._heap[0][0] if self._heap else float("inf")

    def _waits(self, request: PendingRequest) -> bool:
        return request in self and request not in self._taken

    def overdue(self, now_s: float) -> list[PendingRequest]:
        """Return requests whose time has ended, a bounded number."""
        found: list[PendingRequest] = []
        while self._first_deadline_s() <= now_s and len(found) < OVERDUE_PER_TURN:
            found.append(heapq.heappop(self._heap)[2])
        return found

    # --- what they need and wait for ------------------------------------------------------------

    def need(self, wanted: PendingRequest, key: Key) -> None:
        """Keep what is asked for from being evicted until the answer is out."""
        if key not in wanted.needed:
            wanted.needed[key] = None
            self._ledger.need(key)

    def wait_for(self, wanted: PendingRequest, key: Key) -> None:
        """Let a request wait for a load."""
        wanted.outstanding.add(key)
        self._of_load.setdefault(key, {})[wanted] = None

    def wait_for_pages(self, wanted: PendingRequest) -> None:
        """Let a request wait for its ``pages``."""
        for page in wanted.found.pages:
            self._of_page.setdefault(page, {})[wanted] = None

    # --- what is done little by little ----------------------------------------------------------

    def load_finished(self, key: Key) -> None:
        """Note that a load ended, in whichever way, for the requests that wait for it."""

        def note(waiters: Iterable[PendingRequest]) -> Iterator[PendingRequest]:
            for waiter in waiters:
                waiter.outstanding.discard(key)
                yield waiter

        if waiters := self._of_load.pop(key, None):
            self._news.append(note(waiters))

    def page_finished(self, page: int, reason: str = "") -> None:
        """Note for the requests that wait for a page that it has come, or why it cannot be fetched."""

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
        """Make requests that wait for pages find their cells again: the map has other pages now."""

        def note(waiters: Iterable[PendingRequest]) -> Iterator[PendingRequest]:
            for waiter in waiters:
                waiter.outdated = True
                yield waiter

        waiting, self._of_page = self._of_page, {}
        self._news.extend(map(note, waiting.values()))

    def release(self, wanted: PendingRequest) -> None:
        """Release what a request needed, which is over."""

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
        """Leave steps that no client waits for to `tidy`."""
        self._leftovers.append(steps)

    def tidy(self) -> Iterator[PendingRequest]:
        """Do a turn's worth of what is left to do; yield requests that have nothing left to wait for."""
        for one in Walk(self._steps()).for_a_turn():
            if one is not None and (one.outdated or not one.waits) and one in self:
                yield one

    def _steps(self) -> Iterator[PendingRequest | None]:
        """Do what is left to do, waiting requests first; yield after each step."""
        while queue := self._news or self._leftovers:
            step = next(queue[0], self)
            if isinstance(step, WaitingList):  # there is none
                queue.popleft()
            else:
                yield step


def _leave(waiting: dict[Awaited, dict[PendingRequest, None]], what: Awaited, wanted: PendingRequest) -> None:
    """Let a request wait for something no longer."""
    left = waiting.get(what, {})
    left.pop(wanted, None)
    if not left:
        waiting.pop(what, None)

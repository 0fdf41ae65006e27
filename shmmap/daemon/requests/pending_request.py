# SPDX-License-Identifier: Apache-2.0
"""Requests for cells that are not answered yet: what each asks for, and whose patience ends next.

A request may be for very many cells.  Whoever goes through them does so in parts, and lets others have a
turn between two parts (`PendingRequest.pause`).
"""

from __future__ import annotations

import heapq
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.cache.ledger import Ledger
from shmmap.daemon.map.catalogue_view import CatalogueView
from shmmap.daemon.records import Key, Resident
from shmmap.daemon.transport.sessions import Session
from shmmap.errors import NoSession
from shmmap.geometry import Area, distance_to_boxes

__all__ = [
    "CELLS_A_STEP",
    "LOADS_A_STEP",
    "MOST_OF_A_SESSION",
    "Finder",
    "MapChanged",
    "PendingRequest",
    "WaitingList",
    "parts",
]

CELLS_A_STEP: Final = 16
"""Cells that are gone through in one turn: a tenth of a millisecond, where no load is asked for."""
LOADS_A_STEP: Final = 8
"""Loads that are asked for in one turn: a tenth of a millisecond, too."""
MOST_OF_A_SESSION: Final = 64
"""Requests of one session that may wait; further ones are answered at once, what is cold is pending."""
MOST_REQUESTS: Final = 16_384
MOST_CELLS_OF_A_PROCESS: Final = 20_000
MOST_CELLS: Final = 200_000
"""Cells of all requests that wait, a quarter of a kilobyte each; beyond, all are answered at once."""

OVERDUE_AT_ONCE: Final = 256
KEYS_A_STEP: Final = 32
"""Cells of requests and sessions that are over, and requests that a load was for, that one turn sees to."""

Item = TypeVar("Item")
Awaited = TypeVar("Awaited")


def parts(items: Sequence[Item], at_once: int = CELLS_A_STEP) -> Iterator[Sequence[Item]]:
    """Give what is gone through in one turn each."""
    return (items[begin : begin + at_once] for begin in range(0, len(items), at_once))


class MapChanged(Exception):
    """Catalogue indices mean other cells now."""


Finder: TypeAlias = Callable[["PendingRequest"], Iterator[None]]
"""Finds what a request asks for in the map that is served now, a part a turn, and notes it there."""


@dataclass(eq=False, slots=True)
class PendingRequest:
    """What one request asks for, and what of it is still outstanding.

    What it asks for is found (`find`) before it is answered, and found again when another state of the map is
    served, or when a page has come that it waits for.

    Attributes
    ----------
    layers
        What it asks for of each cell, as the reply says it.
    find
        Finds ``cells`` and all that follows, from the request's message.
    area
        What was asked about; None for a request by ids.
    message_cells
        Memory that its message takes, counted in cells.
    cells
        Catalogue index and layer of each handle to send, in reply order.
    catalogue
        The state of the map whose indices they are; None before they are found.
    covered
        Whether all cells of what it asks about are known.
    reason
        Why that is not to be waited for, as the reply says it.
    pages
        Pages of the map that may have more of what it asks about.
    removed, removed_packed
        What the client should drop, as the reply says it.
    unknown
        Ids that the map does not have, with the layers asked for.
    held_old
        Layers of cells that the client holds in an older version.
    refused
        What would exceed the session's quota, with code and message.
    keys, outstanding
        What it waits for in all, and the loads of it that have not ended.
    began_s, deadline_s
        When it began to wait and until when; 0 for a request that does not wait.
    due
        Whether it will be answered in its process's next turn.
    outdated, is_new
        Whether there is more to find than was found; whether what was found is still to be loaded.
    """

    session: Session
    request: int
    layers: tuple[str, ...]
    find: Finder
    area: Area | None = None
    message_cells: int = 0
    cells: list[tuple[int, str]] = field(default_factory=list)
    catalogue: CatalogueView | None = None
    covered: bool = True
    reason: str = ""
    pages: set[int] = field(default_factory=set)
    removed: tuple[str, ...] = ()
    removed_packed: bytes = b""
    unknown: list[tuple[str, str]] = field(default_factory=list)
    held_old: set[Key] = field(default_factory=set)
    refused: dict[Key, tuple[str, str]] = field(default_factory=dict)
    keys: dict[Key, None] = field(default_factory=dict)
    outstanding: set[Key] = field(default_factory=set)
    began_s: float = 0.0
    deadline_s: float = 0.0
    due: bool = False
    outdated: bool = False
    is_new: bool = False

    def find_again(self, cache: CellCache) -> Iterator[None]:
        """Find what it asks for in the map that is served now.

        Raises
        ------
        MapChanged, NoSession
            See `pause`.
        BadRequest
            It asks for too much.
        """
        self.catalogue, self.outdated = cache.catalogue, False
        self.covered, self.reason = True, ""
        self.removed, self.removed_packed = (), b""
        self.cells, self.unknown, self.held_old, self.pages = [], [], set(), set()
        yield from self.find(self)
        self.is_new = True

    def pause(self, cache: CellCache) -> Iterator[None]:
        """Let others have a turn.

        Raises
        ------
        MapChanged
            Meanwhile another state of the map is served: what is asked for has to be found again.
        NoSession
            Meanwhile the session has ended.
        """
        yield
        if not self.session.is_connected:
            raise NoSession("the session ended before the answer was ready", hint="send hello again")
        if cache.catalogue is not self.catalogue:
            raise MapChanged

    @property
    def weight(self) -> int:
        """Memory that it takes, in cells."""
        return max(len(self.cells), self.message_cells)

    @property
    def waits(self) -> bool:
        """Whether something it waits for has neither come nor failed."""
        return bool(self.outstanding or self.pages)

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
    """Requests that wait for loads or pages, what they need, and in which order their patience ends.

    Adding and removing one costs the same however many wait.  What is over, and whom a load concerns, is seen
    to in `tidy`, a bounded part at a time.

    Parameters
    ----------
    ledger
        Told what is needed.
    due
        Called with a request for which all has come, or a page has.
    dropped
        Called with segments that a session does not have any more.
    """

    def __init__(
        self,
        ledger: Ledger,
        due: Callable[[PendingRequest], None],
        dropped: Callable[[list[Resident]], None],
    ) -> None:
        self._ledger = ledger
        self._due = due
        self._dropped = dropped
        self._waiting: dict[Key, dict[PendingRequest, None]] = {}
        self._of_page: dict[int, dict[PendingRequest, None]] = {}
        self._settled: deque[tuple[Callable[[PendingRequest], None], Iterator[PendingRequest]]] = deque()
        self._over: deque[PendingRequest] = deque()
        self._left: deque[tuple[Session, list[Resident]]] = deque()
        self._of: dict[Session, dict[PendingRequest, int]] = {}  # with the number of cells it began with
        self._heap: list[tuple[float, int, PendingRequest]] = []
        self._cells: Counter[int] = Counter()
        self._count = self._all_cells = 0
        self._number = 0

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[PendingRequest]:
        return iter([request for requests in self._of.values() for request in requests])

    def has_room(self, request: PendingRequest) -> bool:
        """Whether this one may wait, too."""
        count, asker = request.weight, request.session.asker
        return (
            self._count < MOST_REQUESTS
            and len(self._of.get(request.session, ())) < MOST_OF_A_SESSION
            and self._cells[asker] + count <= MOST_CELLS_OF_A_PROCESS
            and self._all_cells + count <= MOST_CELLS
        )

    def add(self, request: PendingRequest) -> None:
        """A request waits until its ``deadline_s``, which does not change any more."""
        self._of.setdefault(request.session, {})[request] = 0
        self._count += 1
        self.recount(request)
        self.again(request)

    def recount(self, request: PendingRequest) -> bool:
        """One that waits asks for more cells or fewer now; whether all may go on waiting."""
        asker, mine = request.session.asker, self._of[request.session]
        more = request.weight - mine[request]
        mine[request] += more
        self._cells[asker] += more
        self._all_cells += more
        return self._cells[asker] <= MOST_CELLS_OF_A_PROCESS and self._all_cells <= MOST_CELLS

    def again(self, request: PendingRequest) -> None:
        """One that was due goes on waiting."""
        self._number += 1
        request.due = False
        heapq.heappush(self._heap, (request.deadline_s, self._number, request))

    def __contains__(self, request: PendingRequest) -> bool:
        return request in self._of.get(request.session, ())

    def remove(self, request: PendingRequest) -> None:
        """A request waits no longer."""
        session, asker = request.session, request.session.asker
        count = self._of[session].pop(request)
        if not self._of[session]:
            del self._of[session]
        self._count -= 1
        self._all_cells -= count
        self._cells[asker] -= count
        if not self._cells[asker]:
            del self._cells[asker]
        if len(self._heap) > 2 * self._count + 64:
            self._heap = [entry for entry in self._heap if entry[2] in self]
            heapq.heapify(self._heap)

    def next_deadline_s(self) -> float:
        """When there is something to do: when the next one's patience ends; infinity when none waits."""
        return 0.0 if self._settled or self._over or self._left else self._first_deadline_s()

    def _first_deadline_s(self) -> float:
        while self._heap and not self._waits(self._heap[0][2]):
            heapq.heappop(self._heap)
        return self._heap[0][0] if self._heap else float("inf")

    def overdue(self, now_s: float) -> list[PendingRequest]:
        """Those whose patience has ended, a bounded number at a time."""
        found: list[PendingRequest] = []
        while self._first_deadline_s() <= now_s and len(found) < OVERDUE_AT_ONCE:
            found.append(heapq.heappop(self._heap)[2])
        return found

    def _waits(self, request: PendingRequest) -> bool:
        return request in self and not request.due

    def of(self, session: Session) -> list[PendingRequest]:
        """Those of one session."""
        return list(self._of.get(session, ()))

    # --- what they need -------------------------------------------------------------------------

    def wait_for(self, wanted: PendingRequest, key: Key) -> None:
        """A load of what a request asks for is under way."""
        wanted.outstanding.add(key)
        self._waiting.setdefault(key, {})[wanted] = None

    def wait_for_pages(self, wanted: PendingRequest) -> None:
        """A request waits for its ``pages``."""
        for page in wanted.pages:
            self._of_page.setdefault(page, {})[wanted] = None

    def need(self, wanted: PendingRequest, key: Key) -> None:
        """Keep what is asked for from making room until the answer is out."""
        if key not in wanted.keys:
            wanted.keys[key] = None
            self._ledger.need(key)

    def let_go(self, wanted: PendingRequest) -> None:
        """A request is over: what it needed may go."""
        if wanted.keys or wanted.waits:
            self._over.append(wanted)
            self.tidy()

    def tidy(self) -> None:
        """Tell those who wait of loads that ended, and forget what is over; a bounded part of it."""
        for _ in range(KEYS_A_STEP):
            if self._settled:
                note, waiters = self._settled[0]
                waiter = next(waiters, None)
                if waiter is None:
                    self._settled.popleft()
                    continue
                note(waiter)
                if (waiter.outdated or not waiter.waits) and waiter in self:
                    self._due(waiter)
            elif self._over:
                wanted = self._over[0]
                if wanted.keys:
                    self._ledger.need_no_more(wanted.keys.popitem()[0])
                elif wanted.outstanding:
                    _leave(self._waiting, wanted.outstanding.pop(), wanted)
                elif wanted.pages:
                    _leave(self._of_page, wanted.pages.pop(), wanted)
                else:
                    self._over.popleft()
            elif self._left:
                session, held = self._left[0]
                if held:
                    resident = held.pop()
                    session.drop_segment(resident)
                    self._dropped([resident])
                else:
                    self._left.popleft()
            else:
                break

    def settled(self, key: Key) -> None:
        """A load ended: answer the requests it was the last one for."""
        waiters = self._waiting.pop(key, None)
        if waiters:
            self._settled.append((lambda waiter: waiter.outstanding.discard(key), iter(waiters)))
            self.tidy()

    def page_settled(self, page: int, reason: str = "") -> None:
        """A page has come, or cannot be had for this reason: note it for the requests that wait for it."""

        def note(waiter: PendingRequest) -> None:
            if page in waiter.pages:
                waiter.pages.discard(page)
                waiter.outdated = waiter.outdated or not reason
                waiter.reason = waiter.reason or reason

        waiters = self._of_page.pop(page, None)
        if waiters:
            self._settled.append((note, iter(waiters)))
            self.tidy()

    def map_changed(self) -> None:
        """Pages are others now: find again what waits for some."""

        def note(waiter: PendingRequest) -> None:
            waiter.outdated = True

        waiting, self._of_page = self._of_page, {}
        self._settled.extend((note, iter(waiters)) for waiters in waiting.values())
        self.tidy()

    def left(self, session: Session) -> None:
        """A session is no more: what it held may be free now."""
        self._left.append((session, session.residents()))
        self.tidy()


def _leave(waiting: dict[Awaited, dict[PendingRequest, None]], what: Awaited, wanted: PendingRequest) -> None:
    """A request does not wait for something any more."""
    left = waiting.get(what, {})
    left.pop(wanted, None)
    if not left:
        waiting.pop(what, None)

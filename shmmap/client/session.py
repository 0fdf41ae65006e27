# SPDX-License-Identifier: Apache-2.0
"""State that all requests of one client share: connection, attached cells, lock, and handling of forks.

A request for cells is complete when its handles are attached; handles that became stale meanwhile are
requested again.  A reply has a bounded number of cells: where there are more, the client goes on behind the
last one, and at the end it asks again for what was being loaded.
"""

from __future__ import annotations

import os
import threading
import time
import weakref
from collections.abc import Callable, Generator, Iterable, Sequence
from functools import partial
from itertools import islice
from queue import SimpleQueue
from typing import Any, Final, NoReturn, TypeAlias, TypeVar

import msgspec
import numpy as np

from shmmap.client.attaching import Attacher, check_visible, owner_of_segments
from shmmap.client.cell import Access, Cell
from shmmap.client.cell_set import (
    CellSet,
    HeldCells,
    PendingLayer,
    cell_error,
    joined,
    with_late,
)
from shmmap.client.connection import TURNS, Connection, check_not_within_a_turn, closed
from shmmap.client.request_table import Answers
from shmmap.errors import CellError, LoadFailed, SegmentCorrupt, StaleHandle
from shmmap.failpoints import step
from shmmap.geometry import Area
from shmmap.protocol import messages
from shmmap.protocol.messages import Handle

R = TypeVar("R")

_STALE_ROUNDS: Final = 8  # how often a handle that became stale before it was attached is requested again
_MAX_STALE_WAIT_S: Final = 5.0  # longest wait that such a request allows the daemon


class Asked(msgspec.Struct):
    """A request of several that come to one answer, and what its reply is."""

    make: Callable[[int], messages.Request]
    kind: type[Any]
    timeout_s: float
    quiet_s: float


Ask: TypeAlias = Callable[[int, str, float | None], messages.Request]
"""Makes a request for the cells of an area from a request id, ``start`` and ``wait``."""
Steps: TypeAlias = Generator[Asked, Any, R]
"""Requests that are sent one after another, each after the reply to the one before; returns an answer."""


class Session:
    """One client's session; several threads may use it, and no request waits for another one.

    After a fork the child begins a session of its own with its first request; the parent's
    connection is not touched.

    Parameters
    ----------
    paths
        Socket paths to try, in order.
    timeout_s
        How long a reply may take, in addition to the time that the request lets the daemon wait.
    connect_timeout_s
        How long `Welcome` may take.
    name
        Name of this client in the daemon's lists; empty: the name of its program.
    shm_dir
        Directory of the segments; empty: the directory that the daemon reports.

    Attributes
    ----------
    map_version : int
        State of the map in the last reply about cells.
    attacher : Attacher
        Attaches cells and records mapped segments.
    """

    def __init__(
        self, paths: Sequence[str], *, timeout_s: float, connect_timeout_s: float, name: str, shm_dir: str
    ) -> None:
        self.timeout_s = timeout_s
        self.attacher = Attacher()
        self._paths = tuple(paths)
        self._connect_timeout_s = connect_timeout_s
        self._name = name
        self._shm_dir = shm_dir
        self._attaching = threading.Lock()
        self._connecting = threading.Lock()
        self._closed = False
        self._access_epoch = 0
        self._access: Access | None = None
        self._waiting: list[SimpleQueue[Any]] = []
        self._inherited: list[Connection] = []
        self._connection: Connection | None = None
        self.path = ""
        self.map_version = self._connect().welcome.map_version
        _sessions.append(weakref.ref(self, _sessions.remove))

    def _connect(self) -> Connection:
        connection = Connection(
            self._paths, name=self._name, timeout_s=self._connect_timeout_s, waiting=self._waiting
        )
        self._connection, self.path, self._welcome = connection, connection.path, connection.welcome
        return connection

    def _connected(self) -> Connection:
        """Return the connection; a forked child makes one of its own."""
        connection = self._connection
        if connection is None:
            if self._connecting.locked():
                check_not_within_a_turn(self)
            with self._connecting:
                if self._closed:
                    raise closed("client", "connect again")
                connection = self._connection or self._connect()
        return connection

    @property
    def welcome(self) -> messages.Welcome:
        """The daemon's message when the session began."""
        if self._connection is not None:
            self._welcome = self._connection.welcome
        return self._welcome

    @property
    def lost_since(self) -> float | None:
        """`time.monotonic` when the connection broke; None while it stands, or before it is established."""
        return self._connection.lost_since if self._connection is not None else None

    def notify_when_lost(self, queue: SimpleQueue[Any]) -> None:
        """From now on put None into this queue when the connection breaks."""
        self._waiting.append(queue)

    def stop_notifying(self, queue: SimpleQueue[Any]) -> None:
        """Undo `notify_when_lost`; may be repeated."""
        if queue in self._waiting:
            self._waiting.remove(queue)

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            "what asks the daemon cannot be pickled: it uses this process's connection."
            " Connect in each process, shmmap.connect(...)"
        )

    def close(self) -> None:
        """End the session; attached cells stay readable.

        Raises
        ------
        BadRequest
            A signal handler that interrupted a request calls this.
        """
        connection = self._connection
        if not self._closed and connection is not None:
            self._report_unmapped(connection)
        # a process that holds anything should be kept as a holder
        bye = not self._closed and not self.attacher.any_mapped
        self._closed = True
        if connection is not None:
            connection.close(bye=bye)

    def ask(
        self,
        make: Callable[[int], messages.Request],
        kind: type[R],
        *,
        quiet_s: float = 0.0,
        timeout_s: float | None = None,
    ) -> R:
        """Send the request that ``make`` builds for a request id; return its reply.

        ``quiet_s`` is how long the daemon may work on the request, during which silence is normal.
        ``timeout_s`` is how long the reply may take beyond that, instead of the session's own timeout.
        """
        all_s = (self.timeout_s if timeout_s is None else timeout_s) + quiet_s
        reply: R = self._reply(Asked(make, kind, all_s, quiet_s))
        return reply

    def _next_request(self, asked: Asked) -> tuple[Connection, messages.Request]:
        """Return the connection and a message for it; what was unmapped since is reported before it."""
        connection = self._connected()
        if self.attacher.has_unmapped and not self._attaching.locked():
            self._report_unmapped(connection)
        return connection, asked.make(connection.new_request())

    def _reply(self, asked: Asked) -> Any:
        connection, message = self._next_request(asked)
        return connection.ask(message, asked.kind, timeout_s=asked.timeout_s, quiet_s=asked.quiet_s)

    def run(self, steps: Steps[R]) -> R:
        """Send the requests of ``steps`` and wait for each reply; return the answer."""
        try:
            asked = next(steps)
            while True:
                asked = steps.send(self._reply(asked))
        except StopIteration as end:
            answer: R = end.value
            return answer

    def begin(self, asked: Asked, answers: Answers, for_whom: object) -> Callable[[], None]:
        """Send a request whose reply goes to ``answers``; return what withdraws it."""
        connection, message = self._next_request(asked)
        connection.begin(
            message, answers, timeout_s=asked.timeout_s, quiet_s=asked.quiet_s, for_whom=for_whom
        )
        return partial(connection.withdraw, message.request)

    def drive_by(self, wake: Callable[[], None]) -> tuple[int, Callable[..., float | None]]:
        """Have an event loop send and receive from now on; see `Connection.drive_by`."""
        return self._connected().drive_by(wake)

    def area(
        self,
        area: Area,
        layers: tuple[str, ...],
        wait_s: float | None,
        intent: messages.Intent | None = None,
    ) -> Steps[CellSet]:
        """Ask for the cells of an area; see `shmmap.Client.area`."""
        message = messages.area_to_message(area)
        return self.cells(
            lambda n, start, left_s: messages.Area(n, message, layers, left_s, intent, start), wait_s
        )

    def cells(
        self,
        ask: Ask,
        wait_s: float | None,
        *,
        removed: Callable[[Sequence[str], bytes], tuple[str, ...]] | None = None,
        populate: bool = False,
        timeout_s: float | None = None,
    ) -> Steps[CellSet]:
        """Ask for the cells of an area and attach them, reply after reply.

        Only the last reply waits for loads, so that all have begun by then; what was pending in the others is
        asked for again by id.

        Parameters
        ----------
        wait_s
            Seconds that the requests together let the daemon wait.
        removed
            Returns the removed ids from the reply's two lists of removals.
        populate
            Map every page now, not at first access.
        timeout_s
            Replaces the session's own timeout.
        """
        left_s = _Countdown(wait_s)
        found: list[CellSet] = []
        start = ""
        while start or not found:
            now_s = left_s()
            some, start = yield from self._page(
                lambda n, start=start, now_s=now_s: ask(n, start, now_s),  # type: ignore[misc]
                now_s,
                removed=removed,
                populate=populate,
                timeout_s=timeout_s,
            )
            found.append(some)
        if len(found) == 1:
            return found[0]
        self.map_version = found[0].map_version
        late = {(cell.id, cell.layer) for some in found[:-1] for cell in some.pending}
        if late and left_s():
            ids, layers = tuple(sorted({cell_id for cell_id, _ in late})), found[-1].layers
            again = yield from self.selected(ids, layers, left_s(), populate=populate, timeout_s=timeout_s)
            self.map_version = found[0].map_version
            return with_late(found, again, late)
        return joined(found)

    def selected(
        self,
        ids: tuple[str, ...],
        layers: tuple[str, ...],
        wait_s: float | None,
        intent: messages.Intent | None = None,
        *,
        spare: bool = False,
        populate: bool = False,
        timeout_s: float | None = None,
    ) -> Steps[CellSet]:
        """Ask for cells by id and attach them, some in each request; parameters are those of `cells`."""
        left_s = _Countdown(wait_s)
        most = max(1, messages.MAX_SELECTED // max(1, len(layers)))
        parts = [ids[at : at + most] for at in range(0, len(ids), most)] or [()]

        def ask(part: tuple[str, ...], part_wait_s: float | None) -> Steps[CellSet]:
            some, _ = yield from self._page(
                lambda n: messages.Selected(n, part, layers, part_wait_s, intent, spare),
                part_wait_s,
                populate=populate,
                timeout_s=timeout_s,
            )
            return some

        found: dict[tuple[str, ...], CellSet] = {}
        for part in parts:  # the last one waits, when all loads have begun
            found[part] = yield from ask(part, None if part is not parts[-1] else left_s())
        for part in parts[:-1]:
            if found[part].pending and left_s():
                found[part] = yield from ask(part, left_s())
        return joined([found[part] for part in parts]) if len(parts) > 1 else found[parts[0]]

    def _page(
        self,
        make: Callable[[int], messages.Request],
        wait_s: float | None,
        *,
        removed: Callable[[Sequence[str], bytes], tuple[str, ...]] | None = None,
        populate: bool = False,
        timeout_s: float | None = None,
    ) -> Steps[tuple[CellSet, str]]:
        """Ask once and attach the cells of the reply; return them, and where to go on."""
        quiet_s = wait_s or 0.0
        all_s = (self.timeout_s if timeout_s is None else timeout_s) + quiet_s
        deadline_s = time.monotonic() + all_s
        reply = yield Asked(make, messages.Cells, all_s, quiet_s)
        self.map_version = reply.map_version
        step("client.answer")
        answer = _ReplyCells(self._connected().welcome, self._attach, populate=populate)
        self._take(answer, reply, range(len(reply.cells)))
        for _ in range(_STALE_ROUNDS):
            if not answer.gone or time.monotonic() >= deadline_s:
                break
            again = answer.ask_again(deadline_s)
            answer.welcome = self._connected().welcome
            self._take(answer, *answer.placed((yield again)))
            if answer.gone:  # not at first: a daemon that ends removes all its segments
                welcome = answer.welcome
                check_visible(self._shm_dir or welcome.shm_dir, welcome.segment_prefix)
        return answer.result(reply, removed), reply.next

    def _take(self, answer: _ReplyCells, reply: messages.Cells, places: Iterable[int]) -> None:
        if self._attaching.locked():
            check_not_within_a_turn(self)
        with self._attaching:
            answer.take(reply, places)

    def differential(
        self,
        area: Area,
        held: HeldCells,
        layers: tuple[str, ...],
        wait_s: float | None,
        intent: messages.Intent | None,
        *,
        populate: bool = False,
        timeout_s: float | None = None,
    ) -> Steps[CellSet]:
        """Ask for the cells of an area that are not held; see `shmmap.Client.differential`."""
        message = messages.area_to_message(area)
        return self.cells(
            lambda n, start, left_s: messages.Differential(
                n, message, layers, held.named, held.packed, left_s, intent, start
            ),
            wait_s,
            removed=held.removed,
            populate=populate,
            timeout_s=timeout_s,
        )

    def report_unmapped(self) -> int:
        """Report to the daemon the versions unmapped since the last request; return how many."""
        connection = self._connected()
        reported = self._report_unmapped(connection)
        # the reply to this request means that the report before it has arrived
        connection.ask(
            messages.Release(connection.new_request(), b""), messages.Released, timeout_s=self.timeout_s
        )
        return reported

    def _report_unmapped(self, connection: Connection) -> int:
        if self._attaching.locked():
            check_not_within_a_turn(self)
        with self._attaching:
            versions = self.attacher.unmapped()
            reported = len(versions)
            if versions:
                packed = np.fromiter(versions, "<u8").tobytes()
                connection.send(messages.Release(connection.new_request(), packed))
                versions.clear()
        return reported

    def _attach(self, handle: Handle, welcome: messages.Welcome, populate: bool) -> Cell:
        if (cell := self.attacher.attached(handle)) is not None:
            return cell
        access = self._access
        if access is None or welcome.epoch != self._access_epoch:
            shm_dir = self._shm_dir or welcome.shm_dir
            owner = owner_of_segments(shm_dir, welcome.segment_prefix)
            self._access = access = Access(shm_dir, welcome.session, owner)
            self._access_epoch = welcome.epoch
        return self.attacher.attach(
            handle,
            welcome.whole_id(handle.id),
            welcome.segment_prefix + handle.segment,
            access,
            populate=populate,
        )

    def _restart_in_child(self) -> None:
        if self._connection is not None:
            # referenced, but unused, so that this process never closes the parent's sockets
            self._inherited.append(self._connection)
            self._connection = None
        self._attaching = threading.Lock()
        self._connecting = threading.Lock()
        self._waiting = []
        self.attacher.restart_in_child()


class _ReplyCells:
    """Cells of one reply while they are being attached, each at its place in the reply.

    Parameters
    ----------
    welcome
        What ids and names of segments in the reply lack.
    attach
        Makes a cell from a handle; `StaleHandle` and `SegmentCorrupt` affect that cell only.
    populate
        Map every page now, not at first access.

    Attributes
    ----------
    gone : list
        Places and handles whose segments were gone before they could be attached.
    """

    def __init__(
        self,
        welcome: messages.Welcome,
        attach: Callable[[Handle, messages.Welcome, bool], Cell],
        *,
        populate: bool,
    ) -> None:
        self.welcome = welcome
        self._attach = attach
        self._populate = populate
        self._cells: dict[int, Cell] = {}
        self._failed: list[CellError] = []
        self._pending: list[PendingLayer] = []
        self.gone: list[tuple[int, Handle]] = []
        self._again: tuple[str, ...] = ()

    def take(self, reply: messages.Cells, places: Iterable[int]) -> None:
        """Attach a reply's handles at these places; record which became stale meanwhile and which failed."""
        for place, handle in zip(places, reply.cells, strict=True):
            try:
                self._cells[place] = self._attach(handle, self.welcome, self._populate)
            except StaleHandle:  # noqa: PERF203  one cell must not affect the others
                self.gone.append((place, handle))
            except SegmentCorrupt as error:
                cell_id = self.welcome.whole_id(handle.id)
                message = f"{cell_id} ({handle.layer}): {error}"
                box = (handle.min_x, handle.min_y, handle.max_x, handle.max_y)
                failure = LoadFailed(message, cell_id=cell_id, layer=handle.layer, box=box)
                failure.__cause__ = error
                self._failed.append(failure)
        whole = self.welcome.whole_id
        self._pending += [PendingLayer(whole(cell.id), cell.layer) for cell in reply.pending]
        self._failed += [
            cell_error(cell, cell.id if cell.code == "unknown_cell" else whole(cell.id))
            for cell in reply.failed
        ]

    def ask_again(self, deadline_s: float) -> Asked:
        """Return the request for the handles whose segments were gone before they could be attached."""
        timeout_s = max(deadline_s - time.monotonic(), 1e-3)
        layers = tuple(dict.fromkeys(handle.layer for _, handle in self.gone))
        most = max(1, messages.MAX_SELECTED // len(layers))
        self._again = ids = tuple(islice(dict.fromkeys(handle.id for _, handle in self.gone), most))
        wait_s = min(timeout_s / 2, _MAX_STALE_WAIT_S)
        return Asked(
            lambda n: messages.Selected(n, ids, layers, wait_s), messages.Cells, timeout_s, timeout_s / 2
        )

    def placed(self, reply: messages.Cells) -> tuple[messages.Cells, list[int]]:
        """Return what is new of the reply to `ask_again`, and the places of its cells."""
        gone = [one for one in self.gone if one[1].id in self._again]
        self.gone = [one for one in self.gone if one[1].id not in self._again]
        places: dict[tuple[str, str], list[int]] = {}
        for place, handle in gone:
            places.setdefault((handle.id, handle.layer), []).append(place)
        wanted = [handle for handle in reply.cells if (handle.id, handle.layer) in places]
        repeated = [(place, handle) for handle in wanted for place in places[handle.id, handle.layer]]
        again = messages.Cells(
            reply.request,
            reply.epoch,
            reply.map_version,
            cells=tuple(handle for _, handle in repeated),
            pending=tuple(cell for cell in reply.pending if (cell.id, cell.layer) in places),
            failed=tuple(cell for cell in reply.failed if (cell.id, cell.layer) in places),
        )
        return again, [place for place, _ in repeated]

    def result(
        self,
        reply: messages.Cells,
        removed: Callable[[Sequence[str], bytes], tuple[str, ...]] | None,
    ) -> CellSet:
        """Return the answer; cells whose segments are still gone count as pending."""
        whole = self.welcome.whole_id
        self._pending += [PendingLayer(whole(handle.id), handle.layer) for _, handle in self.gone]
        return CellSet(
            tuple(map(self._cells.__getitem__, sorted(self._cells))),
            tuple(self._failed),
            tuple(self._pending),
            removed(reply.removed, reply.removed_packed) if removed is not None else (),
            reply.epoch,
            reply.map_version,
            reply.layers,
            reply.covered,
            reply.reason,
        )


class _Countdown:
    """What is left of the seconds that requests may wait; None stays None."""

    def __init__(self, wait_s: float | None) -> None:
        self._end_s = None if wait_s is None else time.monotonic() + wait_s

    def __call__(self) -> float | None:
        return None if self._end_s is None else max(0.0, self._end_s - time.monotonic())


TURNS.update(function.__code__ for function in (Session._take, Session._report_unmapped, Session._connected))


_sessions: Final[list[weakref.ref[Session]]] = []
"""All sessions; not a weak set, which runs Python code when a member ends (`shmmap.client.attaching`)."""


def _after_fork_in_child() -> None:
    for one in tuple(_sessions):
        if (session := one()) is not None:
            session._restart_in_child()


os.register_at_fork(after_in_child=_after_fork_in_child)

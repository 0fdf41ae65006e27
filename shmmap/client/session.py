# SPDX-License-Identifier: Apache-2.0
"""State that all requests of one client share: connection, attached cells, lock, and handling of forks.

A request for cells is complete when its handles are attached; handles that became stale meanwhile are
requested again.
"""

from __future__ import annotations

import os
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterable, Sequence
from queue import SimpleQueue
from types import FrameType
from typing import Any, Final, NoReturn, TypeVar

import numpy as np

from shmmap.client.attaching import Attacher, check_visible, owner_of_segments
from shmmap.client.cell import Access, Cell
from shmmap.client.cell_set import CellSet, HeldCells, PendingLayer, cell_error
from shmmap.client.connection import Connection, closed
from shmmap.errors import BadRequest, CellError, LoadFailed, NoAnswer, SegmentCorrupt, StaleHandle
from shmmap.failpoints import step
from shmmap.geometry import Area
from shmmap.protocol import messages
from shmmap.protocol.messages import Handle

__all__ = ["Session"]

R = TypeVar("R")

_STALE_ROUNDS: Final = 5  # how often a handle that became stale before it was attached is requested again
_MAX_STALE_WAIT_S: Final = 5.0  # longest wait that such a request allows the daemon


class Session:
    """One client's session; requests are sent one at a time, other threads wait.

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
    welcome : Welcome
        The daemon's message when the session began.
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
        self._lock = threading.Lock()
        self._closed = False
        self._access_epoch = 0
        self._access: Access | None = None
        self._waiting: list[SimpleQueue[Any]] = []
        self._inherited: list[Connection] = []
        self._connection: Connection | None = None
        self.path = ""
        connection = self._connect()
        self.welcome = connection.welcome
        self.map_version = self.welcome.map_version
        _sessions.append(weakref.ref(self, _sessions.remove))

    def _connect(self) -> Connection:
        connection = Connection(
            self._paths, name=self._name, timeout_s=self._connect_timeout_s, waiting=self._waiting
        )
        self._connection = connection
        self.path = connection.path
        return connection

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
        if self._lock.locked():
            _check_not_within_a_turn(self)
        with self._lock:
            connection = self._connection
            if not self._closed and connection is not None:
                self._report_unmapped(connection)
                if not self.attacher.any_mapped:  # else the daemon should keep this process as a holder
                    connection.send(messages.Bye(connection.new_request()))
            self._closed = True
            if connection is not None:
                connection.close()

    def _in_turn(self, timeout_s: float, work: Callable[[Connection], R]) -> R:
        """Wait until no other thread uses the connection, then use it for one request."""
        if self._lock.locked():
            _check_not_within_a_turn(self)
        entered = False
        try:
            with _Turn(self._lock, timeout_s):  # type: ignore[misc]
                entered = True
                if self._closed:
                    raise closed("client", "connect again")
                connection = self._connection or self._connect()
                self._report_unmapped(connection)
                return work(connection)
        except StopIteration:
            if entered:
                raise
        raise NoAnswer(
            f"another thread's request was under way for {timeout_s:.3g} s",
            hint="give each thread that waits long a client of its own",
        )

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

        def work(connection: Connection) -> R:
            message = make(connection.new_request())
            reply = connection.ask(message, kind, timeout_s=all_s, quiet_s=quiet_s)
            self.welcome = connection.welcome
            return reply

        return self._in_turn(all_s, work)

    def ask_cells(
        self,
        make: Callable[[int], messages.Request],
        wait_s: float | None,
        *,
        removed: Callable[[Sequence[str], bytes], tuple[str, ...]] | None = None,
        populate: bool = False,
        timeout_s: float | None = None,
    ) -> CellSet:
        """Send a request for cells and attach the cells of its reply.

        Parameters
        ----------
        wait_s
            Seconds that the request lets the daemon wait.
        removed
            Returns the removed ids from the reply's two lists of removals.
        populate
            Map every page now, not at first access.
        timeout_s
            Replaces the session's own timeout.
        """
        quiet_s = wait_s or 0.0
        all_s = (self.timeout_s if timeout_s is None else timeout_s) + quiet_s
        deadline_s = time.monotonic() + all_s

        def work(connection: Connection) -> CellSet:
            message = make(connection.new_request())
            reply = connection.ask(message, messages.Cells, timeout_s=all_s, quiet_s=quiet_s)
            self.map_version = reply.map_version
            self.welcome = connection.welcome
            step("client.answer")
            answer = _ReplyCells(lambda handle: self._attach(handle, connection, populate), self.whole_id)
            answer.take(reply, range(len(reply.cells)))
            for _ in range(_STALE_ROUNDS):
                if not answer.gone or time.monotonic() >= deadline_s:
                    break
                answer.ask_again(connection, deadline_s)
                if answer.gone:  # not at first: a daemon that ends removes all its segments
                    check_visible(
                        self._shm_dir or connection.welcome.shm_dir, connection.welcome.segment_prefix
                    )
            self.welcome = connection.welcome
            return answer.result(reply, removed)

        return self._in_turn(all_s, work)

    def ask_differential(
        self,
        area: Area,
        held: HeldCells,
        layers: tuple[str, ...],
        wait_s: float | None,
        intent: messages.Intent | None,
        *,
        populate: bool = False,
        timeout_s: float | None = None,
    ) -> CellSet:
        """Request the cells of an area that are not held; see `shmmap.Client.differential`."""
        message = messages.area_to_message(area)
        return self.ask_cells(
            lambda n: messages.Differential(n, message, layers, held.named, held.packed, wait_s, intent),
            wait_s,
            removed=held.removed,
            populate=populate,
            timeout_s=timeout_s,
        )

    def report_unmapped(self) -> int:
        """Report to the daemon the versions unmapped since the last request; return how many."""

        def work(connection: Connection) -> int:
            reported = self._reported
            # the reply to this request means that the report before it has arrived
            connection.ask(
                messages.Release(connection.new_request(), b""), messages.Released, timeout_s=self.timeout_s
            )
            return reported

        return self._in_turn(self.timeout_s, work)

    def _report_unmapped(self, connection: Connection) -> None:
        versions = self.attacher.unmapped()
        self._reported = len(versions)
        if versions:
            connection.send(
                messages.Release(connection.new_request(), np.fromiter(versions, "<u8").tobytes())
            )
            versions.clear()

    def whole_id(self, cell_id: str) -> str:
        """Return the full cell id of an id that a reply contains."""
        return cell_id if cell_id.startswith("/") else self.welcome.id_prefix + cell_id

    def _attach(self, handle: Handle, connection: Connection, populate: bool) -> Cell:
        welcome = connection.welcome
        access = self._access
        if access is None or welcome.epoch != self._access_epoch:
            shm_dir = self._shm_dir or welcome.shm_dir
            owner = owner_of_segments(shm_dir, welcome.segment_prefix)
            self._access = access = Access(shm_dir, welcome.session, owner)
            self._access_epoch = welcome.epoch
        return self.attacher.attach(
            handle,
            handle.id if handle.id.startswith("/") else welcome.id_prefix + handle.id,
            welcome.segment_prefix + handle.segment,
            access,
            populate=populate,
        )

    def _restart_in_child(self) -> None:
        if self._connection is not None:
            # referenced, but unused, so that this process never closes the parent's sockets
            self._inherited.append(self._connection)
            self._connection = None
        self._lock = threading.Lock()
        self._waiting = []
        self.attacher.restart_in_child()


class _ReplyCells:
    """Cells of one reply while they are being attached, each at its place in the reply.

    Parameters
    ----------
    attach
        Makes a cell from a handle; `StaleHandle` and `SegmentCorrupt` affect that cell only.
    whole_id
        Makes the full cell id from an id in a reply.

    Attributes
    ----------
    gone : list
        Places and handles whose segments were gone before they could be attached.
    """

    def __init__(self, attach: Callable[[Handle], Cell], whole_id: Callable[[str], str]) -> None:
        self._attach = attach
        self._whole = whole_id
        self._cells: dict[int, Cell] = {}
        self._failed: list[CellError] = []
        self._pending: list[PendingLayer] = []
        self.gone: list[tuple[int, Handle]] = []

    def take(self, reply: messages.Cells, places: Iterable[int]) -> None:
        """Attach a reply's handles at these places; record which became stale meanwhile and which failed."""
        for place, handle in zip(places, reply.cells, strict=True):
            try:
                self._cells[place] = self._attach(handle)
            except StaleHandle:  # noqa: PERF203  one cell must not affect the others
                self.gone.append((place, handle))
            except SegmentCorrupt as error:
                cell_id = self._whole(handle.id)
                message = f"{cell_id} ({handle.layer}): {error}"
                box = (handle.min_x, handle.min_y, handle.max_x, handle.max_y)
                failure = LoadFailed(message, cell_id=cell_id, layer=handle.layer, box=box)
                failure.__cause__ = error
                self._failed.append(failure)
        whole = self._whole
        self._pending += [PendingLayer(whole(cell.id), cell.layer) for cell in reply.pending]
        self._failed += [
            cell_error(cell, cell.id if cell.code == "unknown_cell" else whole(cell.id))
            for cell in reply.failed
        ]

    def ask_again(self, connection: Connection, deadline_s: float) -> None:
        """Request again the handles whose segments were gone before they could be attached."""
        gone, self.gone = self.gone, []
        places: dict[tuple[str, str], list[int]] = {}
        for place, handle in gone:
            places.setdefault((handle.id, handle.layer), []).append(place)
        timeout_s = max(deadline_s - time.monotonic(), 1e-3)
        message = messages.Selected(
            connection.new_request(),
            tuple(dict.fromkeys(cell_id for cell_id, _ in places)),
            tuple(dict.fromkeys(layer for _, layer in places)),
            min(timeout_s / 2, _MAX_STALE_WAIT_S),
        )
        reply = connection.ask(message, messages.Cells, timeout_s=timeout_s, quiet_s=timeout_s / 2)
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
        self.take(again, [place for place, _ in repeated])

    def result(
        self,
        reply: messages.Cells,
        removed: Callable[[Sequence[str], bytes], tuple[str, ...]] | None,
    ) -> CellSet:
        """Return the answer; cells whose segments are still gone count as pending."""
        self._pending += [PendingLayer(self._whole(handle.id), handle.layer) for _, handle in self.gone]
        return CellSet(
            tuple(self._cells[place] for place in sorted(self._cells)),
            tuple(self._failed),
            tuple(self._pending),
            removed(reply.removed, reply.removed_packed) if removed is not None else (),
            reply.epoch,
            reply.map_version,
            reply.layers,
            reply.covered,
            reply.reason,
        )


class _Turn:
    """Exclusive use of the connection, released whatever exception a signal handler raises.

    A context manager that waits at most ``timeout_s`` for its lock; after that, entering raises
    `StopIteration`.

    Python runs signal handlers between interpreter steps.  If ``__enter__`` and ``__exit__`` are built-in
    functions, a ``with`` calls them and enters or leaves its block in the same step.  So no handler's
    exception can arrive while the lock is taken outside the block.  Therefore both are not methods here but
    built-in functions, which each object holds in its slots.
    """

    __slots__ = ("__enter__", "__exit__")

    __enter__: Callable[[], object]
    __exit__: Callable[..., None]

    def __init__(self, lock: threading.Lock, timeout_s: float) -> None:
        # False, after a timeout, is filtered out, and there is no next element
        self.__enter__ = filter(None, map(lock.acquire, (True,), (timeout_s,))).__next__
        self.__exit__ = lock.__exit__


_TURNS: Final = (Session._in_turn.__code__, Session.close.__code__)


def _check_not_within_a_turn(session: Session) -> None:
    """Refuse a nested `_Turn` in one thread, which would be a deadlock.

    Raises
    ------
    BadRequest
        This thread is already in a `_Turn` of the session.
    """
    frame: FrameType | None = sys._getframe(2)
    while frame is not None:
        if frame.f_code in _TURNS and frame.f_locals.get("self") is session:
            raise BadRequest(
                "this client is in the middle of a request, which a signal handler has interrupted to use it",
                hint="have the handler set a flag or raise an exception, or use another client there",
            )
        frame = frame.f_back


_sessions: Final[list[weakref.ref[Session]]] = []
"""All sessions; not a weak set, which runs Python code when a member ends (`shmmap.client.attaching`)."""


def _after_fork_in_child() -> None:
    for one in tuple(_sessions):
        if (session := one()) is not None:
            session._restart_in_child()


os.register_at_fork(after_in_child=_after_fork_in_child)

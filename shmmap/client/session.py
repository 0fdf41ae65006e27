# SPDX-License-Identifier: Apache-2.0
"""What all requests of one client share: the connection, the attached cells, a lock, and fork."""

from __future__ import annotations

import math
import os
import threading
import time
import weakref
from collections.abc import Callable, Iterable, Sequence
from queue import SimpleQueue
from typing import Any, Final, NoReturn, TypeVar

import numpy as np

from shmmap.client.answer import Answer
from shmmap.client.arguments import number
from shmmap.client.attaching import Attacher
from shmmap.client.cell import Access, Cell
from shmmap.client.cell_set import CellSet
from shmmap.client.connection import Connection
from shmmap.client.turn import Turn, check_not_within, closed, out_of_time
from shmmap.client.visible import check_visible, owner_of_segments
from shmmap.errors import BadRequest
from shmmap.failpoints import step
from shmmap.protocol import messages
from shmmap.protocol.messages import Handle

__all__ = ["Session"]

R = TypeVar("R")

_STALE_ROUNDS: Final = 5  # how often a handle that went stale before it was attached is asked for again


class Session:
    """One client's session; one request is on its way at a time, other threads wait for it.

    After a fork the child begins a session of its own with its first request; the parent's
    connection is not touched.

    Parameters
    ----------
    paths
        Socket paths to try, in order.
    timeout_s
        How long a reply may take, beyond what a request lets the daemon wait.
    connect_timeout_s
        How long `Welcome` may take.
    name
        How the program appears in the daemon's lists; empty: by its own name.
    shm_dir
        Directory of the segments; empty: as the daemon says.

    Attributes
    ----------
    welcome : Welcome
        What the daemon said when the session began.
    map_version : int
        Of the last reply about cells.
    attacher : Attacher
        Knows what is mapped.
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
        """`time.monotonic` of when the connection broke; None while it stands, or has yet to be made."""
        return self._connection.lost_since if self._connection is not None else None

    def tell_when_lost(self, queue: SimpleQueue[Any]) -> None:
        """From now on put a None into a queue when the connection breaks."""
        self._waiting.append(queue)

    def stop_telling(self, queue: SimpleQueue[Any]) -> None:
        """End `tell_when_lost`; may be repeated."""
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
            This is a signal handler that has interrupted a request.
        """
        if self._lock.locked():
            check_not_within(_TURNS, self)
        with self._lock:
            connection = self._connection
            if not self._closed and connection is not None:
                self._tell_unmapped(connection)
                if not self.attacher.any_mapped:  # else the daemon should still know who holds them
                    connection.tell(messages.Bye(connection.new_request()))
            self._closed = True
            if connection is not None:
                connection.close()

    def _in_turn(self, timeout_s: float, work: Callable[[Connection], R]) -> R:
        """Use the connection for one request, when no other thread does any more."""
        if self._lock.locked():
            check_not_within(_TURNS, self)
        entered = False
        try:
            with Turn(self._lock, timeout_s):  # type: ignore[misc]
                entered = True
                if self._closed:
                    raise closed("client", "connect again")
                connection = self._connection or self._connect()
                self._tell_unmapped(connection)
                return work(connection)
        except StopIteration:
            if entered:
                raise
        raise out_of_time(timeout_s)

    def ask(
        self,
        make: Callable[[int], messages.Request],
        kind: type[R],
        *,
        quiet_s: float = 0.0,
        timeout_s: float | None = None,
    ) -> R:
        """Send the request that ``make`` builds for a request id; returns its reply.

        ``quiet_s`` is how long the daemon may be busy with it, during which silence means nothing,
        ``timeout_s`` how long the reply may take beyond that, instead of the session's own.
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
        """Send a request for cells and attach what it brings.

        Parameters
        ----------
        wait_s
            What the request lets the daemon wait.
        removed
            Makes ids of the reply's two lists of removals.
        populate
            Let the kernel map every page now.
        timeout_s
            Instead of the session's own.
        """
        if wait_s is not None:
            wait_s = number("wait", wait_s)
            if wait_s == math.inf:
                raise BadRequest("wait must be a finite number of seconds")
        quiet_s = wait_s or 0.0
        all_s = (self.timeout_s if timeout_s is None else timeout_s) + quiet_s
        deadline_s = time.monotonic() + all_s

        def work(connection: Connection) -> CellSet:
            message = make(connection.new_request())
            reply = connection.ask(message, messages.Cells, timeout_s=all_s, quiet_s=quiet_s)
            self.map_version = reply.map_version
            self.welcome = connection.welcome
            step("client.answer")
            answer = Answer(lambda handle: self._attach(handle, connection, populate), self.whole_id)
            answer.take(reply, range(len(reply.cells)))
            for _ in range(_STALE_ROUNDS):
                if not answer.gone or time.monotonic() >= deadline_s:
                    break
                answer.ask_again(connection, deadline_s)
                if answer.gone:  # not at first: a daemon that ends takes all its segments away
                    check_visible(
                        self._shm_dir or connection.welcome.shm_dir, connection.welcome.segment_prefix
                    )
            self.welcome = connection.welcome
            return answer.result(reply, removed)

        return self._in_turn(all_s, work)

    def tell_unmapped(self) -> int:
        """Tell the daemon what was unmapped since the last request; returns how many versions."""

        def work(connection: Connection) -> int:
            told = self._told
            # the reply to this one means that the telling before it has arrived
            connection.ask(
                messages.Release(connection.new_request(), b""), messages.Released, timeout_s=self.timeout_s
            )
            return told

        return self._in_turn(self.timeout_s, work)

    def _tell_unmapped(self, connection: Connection) -> None:
        versions = self.attacher.unmapped()
        self._told = len(versions)
        if versions:
            connection.tell(messages.Release(connection.new_request(), _pack(versions)))
            versions.clear()

    def whole_id(self, cell_id: str) -> str:
        """Return the cell id of what a reply carries."""
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
            # left alone, and kept, so that nothing here tries to end the parent's sockets
            self._inherited.append(self._connection)
            self._connection = None
        self._lock = threading.Lock()
        self._waiting = []
        self.attacher.restart_in_child()


_TURNS: Final = (Session._in_turn.__code__, Session.close.__code__)

_sessions: Final[list[weakref.ref[Session]]] = []
"""Those alive; not a weak set, which runs functions in Python when one ends (`shmmap.client.attaching`)."""


def _after_fork_in_child() -> None:
    for one in tuple(_sessions):
        if (session := one()) is not None:
            session._restart_in_child()


os.register_at_fork(after_in_child=_after_fork_in_child)


def _pack(versions: Iterable[int]) -> bytes:
    return np.fromiter(versions, "<u8").tobytes()

# SPDX-License-Identifier: Apache-2.0
"""Follow the daemon's events; lost events are reported.

Numbered events arrive on a SUB socket.  Events missing between two numbers are requested on the request
socket: the daemon remembers the last few thousand.  Events that it no longer remembers are reported as
`MissedEvents`.
"""

from __future__ import annotations

import contextlib
import math
import os
import threading
import time
import weakref
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Final, NoReturn, TypeAlias

import msgspec
import zmq

from shmmap.client.arguments import number, timeout_s
from shmmap.client.connection import Connection, closed
from shmmap.client.connection_watch import ConnectionWatch
from shmmap.client.discovery import candidates
from shmmap.errors import NoAnswer, ProtocolMismatch
from shmmap.protocol.endpoint import endpoint_path
from shmmap.protocol.events import UNNUMBERED, Beat, Event, EventPage, Recent, decode_event

_TIMEOUT_S: Final = 5.0
_SLICE_MS: Final = 100  # interval at which a wait checks whether another thread has closed the stream
_QUEUE: Final = 4096  # events kept while the program does something else; the daemon remembers as many
_OPTIONS: Final = ((zmq.RCVHWM, _QUEUE), (zmq.SUBSCRIBE, b""))


class MissedEvents(msgspec.Struct, frozen=True):
    """Lost events: numbers ``first`` to ``last`` of ``epoch``.

    To learn the current state, request the cells or metadata again.
    """

    epoch: int
    first: int
    last: int


Happening: TypeAlias = Event | MissedEvents


class EventStream:
    """The daemon's events, in order.  One thread may iterate; any thread may close the stream.

    Iterating waits without bound; `next` has a timeout.  When the daemon is restarted the stream
    continues with the new epoch's events from the first one.

    Parameters
    ----------
    endpoint
        Request socket of the daemon, a path or an ``ipc://`` URL, or an instance's name; None means the usual
        places.
    instance
        Name of the daemon's instance, instead of an endpoint.
    since
        Begin with the events of the last ``since`` seconds, as far as the daemon remembers them; None: now.
    name
        Name of this client in the daemon's lists.
    timeout
        Seconds that a request to the daemon may take.

    Attributes
    ----------
    epoch : int
        Identifier of the current daemon run.
    last_message_s : float
        `time.monotonic` of the daemon's last message; it sends one every second.

    Raises
    ------
    DaemonUnreachable, ProtocolMismatch
        As `shmmap.connect`; or the daemon publishes no events.
    """

    def __init__(
        self,
        endpoint: str | os.PathLike[str] | None = None,
        *,
        instance: str | None = None,
        since: float | None = None,
        name: str = "",
        timeout: float = _TIMEOUT_S,
    ) -> None:
        if since is not None:
            since = number("since", since)
        self._timeout_s = timeout_s("timeout", timeout)
        self._connection = Connection(candidates(endpoint, instance=instance), name=name, timeout_s=timeout)
        try:
            path = _events_path(self._connection)
            self._watch = ConnectionWatch(self, f"ipc://{path}", _OPTIONS, kind=zmq.SUB)
        except BaseException:
            self._connection.close()
            raise
        # runs also without close(); not at interpreter exit, where a thread may still use the socket
        self._finalizer = weakref.finalize(self, self._watch.stop)
        self._finalizer.atexit = False
        self._socket = self._watch.socket
        self._using = threading.RLock()
        self._closed = False
        self._ready: deque[Happening] = deque()
        self.epoch = self._connection.welcome.epoch
        self.last_message_s = time.monotonic()
        try:
            self._begin(since)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> EventStream:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            "an EventStream cannot be pickled: it is this process's connection to the daemon."
            " Make one in each process, EventStream(...)"
        )

    def close(self) -> None:
        """End the subscription; another thread that waits for an event gets `BadRequest`."""
        self._closed = True
        with self._using:
            self._watch.stop()
            self._finalizer.detach()
            self._connection.close()

    def __iter__(self) -> Iterator[Happening]:
        while True:
            happening = self.next(None)
            if happening is not None:
                yield happening

    def next(self, timeout: float | None = None) -> Happening | None:
        """Return the next event, or `MissedEvents`; None when nothing happened within ``timeout`` seconds.

        A timeout of None waits without bound; 0 returns only an event that has arrived.
        """
        deadline_s = None if timeout is None else time.monotonic() + number("timeout", timeout)
        while not self._ready:
            left_ms = math.inf if deadline_s is None else max(0, (deadline_s - time.monotonic()) * 1000)
            with self._using:
                if self._closed:
                    raise closed("event stream", "make another one")
                if self._socket.poll(int(min(left_ms, _SLICE_MS))):
                    self._take(self._socket.recv())
                elif left_ms <= _SLICE_MS:
                    return None
        return self._ready.popleft()

    def descriptor(self) -> int:
        """Return a descriptor of the caller's own, which is readable when something has come since `next`.

        It is signalled once: then take all, with ``next(0)`` until that returns None.
        """
        with self._using:
            return os.dup(int(self._socket.getsockopt(zmq.FD)))

    @property
    def path(self) -> str:
        """Path of the daemon's request socket."""
        return self._connection.path

    # --- numbers ----------------------------------------------------------------------------------

    def _begin(self, since: float | None) -> None:
        page = self._ask(Recent(0, limit=0))
        self.epoch, self._expected, self._highest = page.epoch, page.next, 0
        if since is not None:
            since_ns = int(max(time.time() - since, 0.0) * 1e9)
            while not self._catch_up(after=0, since_ns=since_ns):  # the daemon was restarted in between
                self.epoch = self._ask(Recent(0, limit=0)).epoch

    def _take(self, data: bytes) -> None:
        self.last_message_s = time.monotonic()
        event = decode_event(data)
        if event is None:  # an event type that this version does not know: only its number counts
            head = msgspec.msgpack.decode(data)
            number, epoch = int(head[1]), int(head[2])
        else:
            number, epoch = event.seq, event.epoch
        if epoch != self.epoch:
            self._miss(self._highest)
            self.epoch, self._expected, self._highest = epoch, 1, 0
        self._highest = max(self._highest, number)
        numbered = not isinstance(event, UNNUMBERED)
        before = number - 1 if numbered else number
        if before >= self._expected and not self._try_to_catch_up():
            self._miss(before)
        if numbered and number != self._expected:
            return  # a repetition
        self._expected += numbered
        if event is not None and not isinstance(event, Beat):
            self._ready.append(event)

    def _miss(self, last: int) -> None:
        """Report the missing events up to this number as lost: the daemon run that had them is over."""
        if last >= self._expected:
            self._ready.append(MissedEvents(self.epoch, self._expected, last))
            self._expected = last + 1

    def _try_to_catch_up(self) -> bool:
        """Fetch the missing events; return False if they are of a previous run of the daemon.

        If the daemon does not answer, a later call fetches them.
        """
        with contextlib.suppress(NoAnswer):
            return self._catch_up(after=self._expected - 1)
        return True

    def _catch_up(self, *, after: int, since_ns: int = 0) -> bool:
        """Fetch the events after this number; return False if the daemon has another epoch."""
        while True:
            page = self._ask(Recent(0, after=after, since_unix_ns=since_ns))
            if page.epoch != self.epoch:
                return False
            if page.first > after + 1 and not since_ns:
                self._ready.append(MissedEvents(page.epoch, after + 1, page.first - 1))
                after = page.first - 1
            for data in page.events:
                event = decode_event(data)
                if event is not None:
                    after = event.seq
                    self._ready.append(event)
                else:
                    after = int(msgspec.msgpack.decode(data)[1])
            self._expected = after + 1 if page.events else page.next
            if not page.events:
                return True

    def _ask(self, message: Recent) -> EventPage:
        message.request = self._connection.new_request()
        return self._connection.ask(message, EventPage, timeout_s=self._timeout_s)


def _events_path(connection: Connection) -> str:
    path = connection.welcome.events
    if not path:
        raise ProtocolMismatch("this daemon publishes no events", hint="update it")
    # in another mount namespace the directory has another name than the daemon knows
    beside = Path(connection.path).parent / Path(path).name
    return endpoint_path(str(beside) if beside.exists() else path)

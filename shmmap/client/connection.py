# SPDX-License-Identifier: Apache-2.0
"""One session with the daemon: requests, deadlines, resending, and reconnecting after a restart.

A request travels on a DEALER socket, which reconnects by itself.  While nothing else is under way its caller
sends and receives.  A request that is not answered at once goes into a table of outstanding requests
(`shmmap.client.request_table`), and the connection's thread receives from then on, until the table is empty.
So a request that begins waits for no other one.  The thread only sorts replies: each caller takes its own
out of a queue.  An event loop may do the thread's work (`Connection.drive_by`).

The thread that uses the socket holds a lock: a caller that waits for its reply for at most `_ALONE_MS`, and
once others have asked beside it for at most `_SHARED_MS`.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import sys
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Sequence
from queue import Empty, SimpleQueue
from types import FrameType
from typing import Any, Final, TypeVar

import zmq

from shmmap.client.connection_watch import CONNECTION, FILES, ConnectionWatch, stop_orphans
from shmmap.client.discovery import find_socket
from shmmap.client.request_table import Answers, Outstanding, RequestTable
from shmmap.errors import (
    BadRequest,
    InternalError,
    LimitReached,
    LiveInterrupted,
    NoAnswer,
    ProtocolMismatch,
    ShmmapError,
    error_from_wire,
)
from shmmap.protocol.codec import decode_reply, encode, encode_request
from shmmap.protocol.messages import PROTOCOL_VERSION, Bye, ErrorReply, Hello, Reply, Request, Welcome
from shmmap.segment.process_limits import check_files

R = TypeVar("R")

_ALONE_MS: Final = 20  # how long a caller waits itself for its reply
_SHARED_MS: Final = 2  # the same if others have asked meanwhile, before
_LINGER_S: Final = 1.0  # how long the thread looks at the socket after the last reply, and at most in one go
_HUNG_UP_S: Final = 0.1  # after this long without another try, libzmq has given the peer up
_LATE_S: Final = 1.0  # how much later than its deadline a caller gives up without the thread
_NOTICED_S: Final = 0.5  # how often a caller notices signals at least: one just before a wait does not end it
_QUEUE: Final = 64  # messages that may wait for a slow daemon
_OPTIONS: Final = (
    (zmq.IMMEDIATE, 1),  # nothing queues up for an absent daemon
    (zmq.SNDHWM, _QUEUE),
    (zmq.RCVTIMEO, _ALONE_MS),
)
_POLLIN: Final = int(zmq.POLLIN)  # operators of zmq's enumerations take microseconds
_SILENT_HINT: Final = "the daemon is stopped, hung, overloaded or gone: see `shmmap health`"
_UPDATE_HINT: Final = "update the older of client and daemon"
_MAX_NAME: Final = 64  # characters of a program's name that the daemon keeps
SERVED_PAUSE_S: Final = 0.05
"""Pause between two tries to reach a live map: no event reports that its process is running again."""


class _Exchange:
    """The socket, its session and the outstanding requests, which `Connection` and its thread share.

    The thread must not keep the connection: that one's end is what ends the thread.
    """

    def __init__(self, watch: ConnectionWatch, path: str, name: str) -> None:
        self.watch, self.path, self.name = watch, path, name
        self.socket, self.lock = watch.socket, watch.lock
        self.table = RequestTable()
        self.withdrawn: deque[tuple[int, bool]] = deque()  # requests that the thread should forget
        self.numbers = itertools.count(int.from_bytes(os.urandom(6), "little"))
        self.welcome: Welcome | None = None
        self.slot = 0  # kept over restarts of the daemon: mapped segments are locked under it
        self.handshakes = -1  # the connection on which the session began; -1: there is none
        self.is_closed = self._is_shared = False
        self.wake = watch.wake
        self.is_driven = False  # by an event loop, which receives all
        self._greeted_on = 0
        self._is_serving = False
        self._wakes_s = math.inf

    @property
    def is_idle(self) -> bool:
        """Whether a caller may send and receive by itself."""
        table = self.table
        return (
            not table.entries
            and self.handshakes == self.watch.handshakes
            and table.hello is None
            and not table.cancels
            and not self.withdrawn
            and not self.is_driven
        )

    def send(self, data: bytes) -> bool:
        """Send a message; return False if the daemon takes none at present."""
        try:
            self.socket.send(data, zmq.DONTWAIT)
        except zmq.Again:
            return False
        return True

    def receive_alone(self, request: int) -> Reply | None:
        """Return the reply to a request just sent, the only one under way; None if it takes longer."""
        while True:
            try:
                reply = decode_reply(self.socket.recv())
            except zmq.Again:
                return None
            if reply.request == request:
                return reply

    def share(self) -> None:
        """Let callers from now on wait less for their replies by themselves; needs the lock."""
        if not self._is_shared:
            self.socket.setsockopt(zmq.RCVTIMEO, _SHARED_MS)
            self._is_shared = True

    def add(self, entry: Outstanding, *, sent_s: float | None) -> None:
        """Add a request to the table; wake the thread if it has to look at it."""
        table = self.table
        table.add(entry, sent_s=sent_s)
        is_lost = table.hello is not None or self.handshakes != self.watch.handshakes
        if sent_s is None and not is_lost and table.next_to_send() is entry.data and self.send(entry.data):
            table.sent(time.monotonic())
        if (
            is_lost
            or not self._is_serving
            or table.next_s < self._wakes_s
            or table.cancels
            or int(self.socket.getsockopt(zmq.EVENTS)) & _POLLIN  # sending took the signal of what has come
        ):
            self.wake()

    # --- the thread, or the event loop ----------------------------------------------------------------

    def serve(self) -> float | None:
        """Send and receive; return in how many seconds to do it again, None if nothing is under way."""
        table = self.table
        if not (table.is_busy or self.withdrawn):
            # in this order: `add` looks at it after it has added
            self._is_serving = False
            if not (table.is_busy or self.withdrawn):
                return None
        return self.work()

    def work(self, *, is_timer: bool = False) -> float | None:
        """Send and receive; return in how many seconds to do it again.

        None if that is over; or if nothing is under way and this was only about time.
        """
        table = self.table
        self._is_serving = True
        with self.lock:
            now_s = time.monotonic()
            if self.is_closed:
                return None
            try:
                self._send_and_receive(now_s)
            except ShmmapError as error:  # of a reply that cannot be read
                self._fail(error)
            except Exception as error:  # noqa: BLE001  without this thread no request would be answered
                self._fail(InternalError(f"the connection's thread failed: {error!r}"))
            if is_timer and not table.is_busy:
                self._wakes_s = math.inf
                return None
            self._wakes_s = min(table.next_s, now_s + _LINGER_S)
            if self.watch.hung_up_since is not None:
                self._wakes_s = min(self._wakes_s, now_s + _HUNG_UP_S)
        return max(0.0, self._wakes_s - now_s)

    def _send_and_receive(self, now_s: float) -> None:
        table, watch, socket = self.table, self.watch, self.socket
        if self.withdrawn:
            table.withdraw([self.withdrawn.popleft() for _ in range(len(self.withdrawn))], now_s)
        if table.hello is None:
            if self.handshakes != watch.handshakes:
                self._begin_session(now_s)
        elif self._greeted_on != watch.handshakes:
            table.hello.due_s = math.inf
        since_s = watch.hung_up_since
        # libzmq retries after a broken connection, but not if the socket types are incompatible (SUB, for
        # example)
        if watch.foreign or (since_s is not None and now_s >= since_s + _HUNG_UP_S):
            raise ProtocolMismatch(
                f"{self.path}: what listens there is no shmmap daemon",
                hint="is this the socket of another program?",
            )
        while True:
            self._receive(now_s)
            table.tick(now_s, self._silence_of)
            is_sent = False
            while (data := table.next_to_send()) is not None and self.send(data):
                is_sent = True
                if table.hello is not None:
                    self._take_events()  # else this connection looks like the next one
                    self._greeted_on = watch.handshakes
                table.sent(now_s)
            # sending takes the signal of what has come meanwhile
            if not (is_sent and int(socket.getsockopt(zmq.EVENTS)) & _POLLIN):
                return

    def _receive(self, now_s: float) -> None:
        table, hello = self.table, self.table.hello
        while int(self.socket.getsockopt(zmq.EVENTS)) & _POLLIN:
            reply = decode_reply(self.socket.recv(zmq.DONTWAIT))
            if hello is not None and reply.request == hello.request:
                self._welcomed(reply)
            elif table.receive(reply, now_s):
                self._begin_session(now_s)
            hello = table.hello

    def _begin_session(self, now_s: float) -> None:
        hello = Hello(next(self.numbers), *PROTOCOL_VERSION, self.name, self.slot)
        self.table.begin_session(
            Outstanding(
                hello, encode(hello), SimpleQueue(), now_s=now_s, deadline_s=math.inf, wait_s=0.0,
                request=hello.request,
            ),
            now_s,
        )  # fmt: skip

    def _welcomed(self, reply: Reply) -> None:
        if isinstance(reply, ErrorReply):
            raise error_from_wire(reply.code, reply.message, reply.hint)
        if not isinstance(reply, Welcome):
            raise ProtocolMismatch(
                f"{self.path}: the answer to Hello was {type(reply).__name__}", hint=_UPDATE_HINT
            )
        if reply.major != PROTOCOL_VERSION[0]:
            older = "daemon" if reply.major < PROTOCOL_VERSION[0] else "client"
            raise ProtocolMismatch(
                f"{self.path}: the daemon speaks protocol {reply.major}.{reply.minor}, "
                f"this client {PROTOCOL_VERSION[0]}.{PROTOCOL_VERSION[1]}",
                hint=f"update the {older}, and restart it",
            )
        self._take_events()
        self.slot, self.welcome, self.handshakes = reply.session, reply, self.watch.handshakes
        self.table.session_begun(reply)

    def _take_events(self) -> None:
        if not self.watch.take_events():
            self.watch.wake()  # its thread, which has to end

    def _fail(self, error: ShmmapError) -> None:
        """End all requests with an error; the next one begins a session."""
        if self.table.hello is not None:
            self.table.hello.due_s = math.inf
        self.table.fail_all(lambda: type(error)(error.message, hint=error.hint))

    def _silence_of(self, entry: Outstanding) -> ShmmapError:
        """Return why there is no reply: the daemon's silence, or this process's lack of descriptors."""
        if self.watch.lost_since is not None or not self.watch.handshakes:
            try:
                check_files(1, CONNECTION)
            except LimitReached as limit:
                return limit
        took = f"{entry.timeout_s:.3g} s"
        what = f"no answer within {took}"
        if self.table.hello is not None:
            what = f"connected, but no welcome within {took}"
        return NoAnswer(f"{self.path}: {what}", hint=_SILENT_HINT)


class Connection:
    """A session with the daemon on a DEALER socket; several threads may use it.

    Parameters
    ----------
    paths
        Socket paths to try, in order.
    name
        Name of this client in the daemon's lists; empty: the name of its program.
    timeout_s
        Seconds until `Welcome` must have arrived.
    waiting
        Queues that receive None when the connection breaks; may change at any time.

    Attributes
    ----------
    path : str
        Path at which the daemon listens.

    Raises
    ------
    DaemonUnreachable, ProtocolMismatch
        As `shmmap.client.discovery.find_socket`, and when no `Welcome` arrives in time.
    LimitReached
        This process may not have the descriptors or threads that a connection needs.
    """

    def __init__(
        self,
        paths: Sequence[str],
        *,
        name: str = "",
        timeout_s: float,
        waiting: Sequence[SimpleQueue[Any]] = (),
    ) -> None:
        check_files(FILES, CONNECTION)
        deadline_s = time.monotonic() + timeout_s
        self.path = find_socket(paths, deadline_s)
        stop_orphans()
        self._watch = ConnectionWatch(self, f"ipc://{self.path}", _OPTIONS, waiting)
        # runs also without close(); not at interpreter exit, where threads may still use the socket
        self._finalizer = weakref.finalize(self, self._watch.stop)
        self._finalizer.atexit = False
        self._exchange = _Exchange(self._watch, self.path, name or program_name())
        self._watch.serve = self._exchange.serve
        self._greet(deadline_s)

    def _greet(self, deadline_s: float) -> None:
        now_s = time.monotonic()
        answers: SimpleQueue[Outstanding] = SimpleQueue()
        entry = Outstanding(
            None, b"", answers, now_s=now_s, deadline_s=deadline_s, wait_s=0.0, request=self.new_request()
        )
        with self._exchange.lock:
            self._exchange.add(entry, sent_s=None)
        reply = self._taken(entry, answers)
        if isinstance(reply, BaseException):
            raise reply

    def close(self, *, bye: bool = False) -> None:
        """End the connection; messages just sent get a short time to be delivered.

        Requests that are under way end with `BadRequest`.  With ``bye`` the daemon ends the session at once.
        """
        exchange = self._exchange
        if exchange.lock.locked() or exchange.table.entries:
            check_not_within_a_turn(self)
        with exchange.lock:
            if bye and not exchange.is_closed:
                exchange.send(encode(Bye(self.new_request())))
            exchange.is_closed = True
            exchange.table.fail_all(lambda: BadRequest("this client is closed", hint="connect again"))
        self._watch.stop()
        self._finalizer.detach()
        stop_orphans()

    @property
    def welcome(self) -> Welcome:
        """Description of the daemon, as received when the session began."""
        welcome = self._exchange.welcome
        assert welcome is not None  # noqa: S101  set before the constructor returns
        return welcome

    @property
    def lost_since(self) -> float | None:
        """`time.monotonic` of when the connection broke; None while it stands."""
        return self._watch.lost_since

    def new_request(self) -> int:
        """Return a request id not used before."""
        return next(self._exchange.numbers)

    def send(self, message: Request) -> None:
        """Send a message without waiting for a reply; it is lost if the daemon is absent."""
        data = encode_request(message)
        if self._exchange.lock.locked():
            check_not_within_a_turn(self)
        with self._exchange.lock:
            if not self._exchange.is_closed:
                self._exchange.send(data)

    def ask(self, message: Request, kind: type[R], *, timeout_s: float, quiet_s: float = 0.0) -> R:
        """Send a request and return its reply; begin a new session if the daemon lost this one.

        Parameters
        ----------
        kind
            The reply's type.
        timeout_s
            How long the reply may take.
        quiet_s
            How long the request lets the daemon wait, during which silence is normal.

        Raises
        ------
        BadRequest
            The request is larger than the daemon accepts, or a signal handler asks that has interrupted
            another request; nothing was sent.
        NoAnswer
            No reply before the deadline.
        ShmmapError
            The error with which the daemon refused the request.
        """
        data = _encoded(message)
        exchange = self._exchange
        if is_beside := exchange.lock.locked() or bool(exchange.table.entries):
            check_not_within_a_turn(self)
        try:
            answers = None
            reply: Reply | ShmmapError | None = None
            with exchange.lock:
                if exchange.is_closed:
                    raise closed("client", "connect again")
                if is_beside:
                    exchange.share()
                sent_s = None
                if exchange.is_idle and exchange.send(data):
                    reply = exchange.receive_alone(message.request)
                    if reply is not None and isinstance(reply, ErrorReply) and reply.code == "no_session":
                        reply, exchange.handshakes = None, -1
                    elif reply is None:
                        sent_s = time.monotonic()
                if reply is None:
                    answers = SimpleQueue[Outstanding]()
                    now_s = time.monotonic()
                    entry = Outstanding(
                        message, data, answers, now_s=now_s, deadline_s=now_s + timeout_s, wait_s=quiet_s,
                        request=message.request,
                    )  # fmt: skip
                    exchange.add(entry, sent_s=sent_s)
            if answers is not None:
                reply = self._taken(entry, answers)
        except BaseException:
            self.withdraw(message.request, waits=quiet_s > 0)
            raise
        if isinstance(reply, kind):
            return reply
        if exchange.is_closed:
            raise closed("client", "connect again")
        raise reply_error(message, reply)

    def _taken(self, entry: Outstanding, answers: SimpleQueue[Outstanding]) -> Reply | ShmmapError:
        """Wait for a reply, or for the thread's word that there is none."""
        # the timeout is for the end of the interpreter, when the thread stands still
        end_s = time.monotonic() + entry.timeout_s + _LATE_S
        while True:
            with contextlib.suppress(Empty):
                answers.get(timeout=_NOTICED_S)
                break
            if time.monotonic() >= end_s:
                return self._exchange._silence_of(entry)
        assert entry.reply is not None  # noqa: S101  that is what was waited for
        return entry.reply

    def begin(
        self, message: Request, answers: Answers, *, timeout_s: float, quiet_s: float, for_whom: object
    ) -> None:
        """Send a request whose reply goes to ``answers``, as the `Outstanding` that has ``for_whom``."""
        data = _encoded(message)
        exchange = self._exchange
        if exchange.lock.locked():
            check_not_within_a_turn(self)
        try:
            with exchange.lock:
                if exchange.is_closed:
                    raise closed("client", "connect again")
                exchange.share()
                now_s = time.monotonic()
                entry = Outstanding(
                    message, data, answers, now_s=now_s, deadline_s=now_s + timeout_s, wait_s=quiet_s,
                    request=message.request, for_whom=for_whom,
                )  # fmt: skip
                exchange.add(entry, sent_s=None)
        except BaseException:
            self.withdraw(message.request, waits=quiet_s > 0)
            raise

    def withdraw(self, request: int, *, waits: bool = False) -> None:
        """Forget a request whose answer is not wanted; where it ``waits`` in the daemon, cancel it there.

        A signal handler may call this at any time.
        """
        exchange = self._exchange
        exchange.withdrawn.append((request, waits))  # whatever interrupts the rest, the thread finds it
        exchange.wake()

    def drive_by(self, wake: Callable[[], None]) -> tuple[int, Callable[..., float | None]]:
        """Have an event loop send and receive from now on, instead of the connection's thread.

        Parameters
        ----------
        wake
            Called, in any thread, when the loop should call what is returned.

        Returns
        -------
        int
            A descriptor of the caller's own, to be watched for reading.
        callable
            To be called when that is readable, after ``wake``, and, with ``is_timer=True``, after the seconds
            that it has returned last.
        """
        exchange = self._exchange
        with exchange.lock:
            exchange.wake, exchange.is_driven = wake, True
            self._watch.serve = wake  # after what happens to the connection; returns None
            file = os.dup(int(exchange.socket.getsockopt(zmq.FD)))
        self._watch.wake()  # the thread leaves the socket alone from now on
        return file, exchange.work


def _encoded(message: Request) -> bytes:
    try:
        return encode_request(message)
    except (TypeError, ValueError, OverflowError) as error:
        raise BadRequest(f"the request cannot be sent: {error}") from None


def reply_error(message: Request, reply: Reply | ShmmapError | None) -> ShmmapError:
    """Return the error of a request that was not answered as it should."""
    if isinstance(reply, ShmmapError):
        return reply
    if isinstance(reply, ErrorReply):
        return error_from_wire(reply.code, reply.message, reply.hint)
    return ProtocolMismatch(
        f"the daemon answered a request {type(message).__name__} with {type(reply).__name__}",
        hint=_UPDATE_HINT,
    )


TURNS: Final = {
    function.__code__ for function in (Connection.ask, Connection.begin, Connection.send, Connection.close)
}
"""Code that must not be interrupted to do the same; `shmmap.client.session` adds its own."""


def check_not_within_a_turn(whose: object) -> None:
    """Refuse to take a lock that this thread holds, which would be a deadlock.

    Raises
    ------
    BadRequest
        This thread is already using this connection or session.
    """
    frame: FrameType | None = sys._getframe(2)
    while frame is not None:
        if frame.f_code in TURNS and frame.f_locals.get("self") is whose:
            raise BadRequest(
                "this client is in the middle of a request, which a signal handler has interrupted to use it",
                hint="have the handler set a flag or raise an exception, or use another client there",
            )
        frame = frame.f_back


def program_name() -> str:
    """Return the default name of this program, at most 64 characters.

    It is the script's file name, or the module's name after ``python -m``; empty if there is neither.  For
    the ``__main__`` module of a package it is the package's name.
    """
    spec = getattr(sys.modules.get("__main__"), "__spec__", None)
    if spec is not None and spec.name != "__main__":  # python -m package.module
        name: str = spec.name.removesuffix(".__main__")
    else:
        name = os.path.basename(sys.argv[0]) if sys.argv else ""
        if name in ("-c", "-"):  # python -c, and a program on standard input
            name = ""
    return name[:_MAX_NAME]


def closed(what: str, hint: str) -> BaseException:
    """Return the exception for a request on a closed object.

    While the interpreter ends, the exception ends the requesting thread silently: nothing waits for it.
    """
    main = threading.main_thread()
    if not main.is_alive() and threading.get_ident() != main.ident:
        return SystemExit()
    return BadRequest(f"this {what} is closed", hint=hint)


def until_served(ask: Callable[[], R], timeout_s: float) -> R:
    """Repeat a request about a live map until its process, which may be restarting, answers.

    Raises
    ------
    LiveInterrupted
        The process did not answer within ``timeout_s`` seconds.
    """
    end_s = time.monotonic() + timeout_s
    while True:
        try:
            return ask()
        except LiveInterrupted:  # noqa: PERF203  retrying is the purpose
            if time.monotonic() >= end_s:
                raise
            time.sleep(SERVED_PAUSE_S)

# SPDX-License-Identifier: Apache-2.0
"""A connection's socket, and the thread that makes it, watches its connection, and closes it.

The thread is where libzmq's parts belong because signal handlers run in the main thread alone: no handler's
exception can leave a part behind that nothing refers to.  For the same reason it is started by one function
that is built in, and is waited for in queues.  The thread lets no signal interrupt it: the kernel may give
one to any thread, and a context whose end it interrupts stays, with a thread and five descriptors.

Where the interpreter ends nothing is closed: another thread may be using the socket, and libzmq ends the
process when one is closed under its user.  Python stops such threads, and the kernel closes what is open.

A thread may also outlive its owner, which did not stop it because an exception came when it ended: Python
ends objects by functions written in Python, at whose first step a signal handler's exception may come.  The
next connection stops such threads (`stop_orphans`).
"""

from __future__ import annotations

import _thread
import contextlib
import os
import struct
import time
import weakref
from collections.abc import Callable, Sequence
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, Final, Protocol

import zmq

from shmmap.errors import LimitReached
from shmmap.segment.process_limits import check_files, check_threads, no_threads_left

if TYPE_CHECKING:
    import signal as _signal
else:
    import _signal  # `signal` is the same with enumerations, which take a millisecond to import

__all__ = [
    "CONNECTION",
    "FILES",
    "ConnectionWatch",
    "Running",
    "enter",
    "running",
    "start_thread",
    "stop_orphans",
]

_EVENT: Final = struct.Struct("=HI")  # first frame of a message of zmq_socket_monitor(3): event, value
_EVENTS: Final = (
    zmq.EVENT_HANDSHAKE_SUCCEEDED
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_DISCONNECTED
    | zmq.EVENT_CONNECT_RETRIED
    | zmq.EVENT_MONITOR_STOPPED
)
_OURS: Final = frozenset({_signal.SIGBUS, _signal.SIGFPE, _signal.SIGILL, _signal.SIGSEGV})
"""Signals that a thread brings upon itself; they are not to be put off."""
_LAST_WORDS_MS: Final = 100  # closing may take this long to deliver a last message
CONNECTION: Final = "a connection to the daemon"
FILES: Final = 10
"""Descriptors that libzmq needs (context, socket, monitor, connection), and one to map segments by."""
THREADS: Final = 2
"""Threads of libzmq for a context, beside the one that makes it."""
_OVER_S: Final = 0.5  # a wait for the end looks again after this long, should another have waited, too


class Running(Protocol):
    """What runs in a thread on behalf of an owner."""

    @property
    def owner(self) -> weakref.ref[object]:
        """The object that stops it."""

    def request_stop(self) -> None:
        """Ask it to end, soon."""


running: Final[set[Running]] = set()
"""What runs in threads at present; each thread adds and removes its own."""


def enter(one: Running) -> None:
    """Begin what runs in this thread; its owner may be gone already, and no connection may come later."""
    running.add(one)
    if one.owner() is None:
        one.request_stop()


def stop_orphans() -> None:
    """Stop the threads whose owner is gone."""
    for one in tuple(running):
        if one.owner() is None:
            one.request_stop()


def start_thread(run: Callable[..., object], *arguments: object) -> None:
    """Start a thread by one function that is built in: no signal handler runs in the middle.

    Raises
    ------
    LimitReached
        This process may have no more threads.
    SystemExit
        The interpreter is ending, and starts none: the thread that asks ends, too, and quietly.
    """
    try:
        _thread.start_new_thread(run, arguments)
    except RuntimeError as error:
        if "shutdown" in str(error):  # as Python calls it since 3.12
            raise SystemExit from None
        raise no_threads_left("no thread can be started: ") from None


class ConnectionWatch:
    """One socket, made and ended by a thread, and what libzmq said of its connection.

    Parameters
    ----------
    owner
        Uses the socket, and stops the thread.
    endpoint
        What the socket connects to.
    options
        Of the socket.
    waiting
        Gets a None in each of these queues when the connection breaks; may change at any time.
    kind
        Of socket.

    Attributes
    ----------
    handshakes : int
        How often the connection was made.
    lost_since : float or None
        `time.monotonic` of when it broke; None while it stands, and before it was first made.
    hung_up : bool
        The other side hung up before any handshake, and libzmq did not try again yet.
    foreign : bool
        What listens there speaks something else.

    Raises
    ------
    LimitReached
        This process may not have the descriptors or threads that are needed.
    """

    def __init__(
        self,
        owner: object,
        endpoint: str,
        options: Sequence[tuple[int, int | bytes]],
        waiting: Sequence[SimpleQueue[Any]] = (),
        kind: int = zmq.DEALER,
    ) -> None:
        self.owner = weakref.ref(owner)
        self.handshakes = 0
        self.lost_since: float | None = None
        self.hung_up = False
        self.foreign = False
        self._waiting = waiting
        self._pid = os.getpid()
        self._made: SimpleQueue[BaseException | None] = SimpleQueue()
        self._connected: SimpleQueue[None] = SimpleQueue()
        self._over: SimpleQueue[None] = SimpleQueue()
        self._stopping = False
        self._ended = False
        self._thread = 0
        self._socket: zmq.Socket[bytes] | None = None
        check_files(FILES, CONNECTION)
        start_thread(self._run, endpoint, options, kind)
        failure = self._made.get()
        if failure is not None:
            raise failure from None

    @property
    def socket(self) -> zmq.Socket[bytes]:
        """For one thread at a time to send and receive."""
        assert self._socket is not None  # noqa: S101  there is one where the constructor has returned
        return self._socket

    def wait_until_connected(self, timeout_s: float) -> None:
        """Wait for the first handshake."""
        if not self.handshakes:
            with contextlib.suppress(Empty):
                self._connected.get(timeout=max(timeout_s, 0.0))

    def stop(self) -> None:
        """Make the thread close the socket and end, and wait for it, unless this is that thread itself."""
        self.request_stop()
        while not self._elsewhere and _thread.get_ident() != self._thread and not self._ended:
            with contextlib.suppress(Empty):
                self._over.get(timeout=_OVER_S)

    @property
    def _elsewhere(self) -> bool:
        """Whether this is a forked child: the socket is the parent's."""
        return os.getpid() != self._pid

    def request_stop(self) -> None:
        """Make the thread close the socket and end."""
        self._stopping = True  # where there is no socket yet, the thread looks at this when it has made it
        while self._socket is not None and not self._ended and not self._elsewhere:
            try:
                self._socket.disable_monitor()
            except zmq.error.InterruptedSystemCall:
                continue
            except zmq.ZMQError:  # the thread is at its end already
                return
            return

    def _run(self, endpoint: str, options: Sequence[tuple[int, int | bytes]], kind: int) -> None:
        self._thread = _thread.get_ident()
        try:
            _signal.pthread_sigmask(_signal.SIG_BLOCK, _signal.valid_signals() - _OURS)
            with contextlib.ExitStack() as ends:
                ends.callback(running.discard, self)
                enter(self)
                check_threads(THREADS, CONNECTION)
                # a context of our own: no other library's sockets can hold up its end
                context = zmq.Context()
                ends.callback(context.term)
                socket = context.socket(kind)
                ends.callback(socket.close, linger=_LAST_WORDS_MS)
                for option, value in options:
                    socket.setsockopt(option, value)
                monitor = socket.get_monitor_socket(_EVENTS)
                ends.callback(monitor.close, linger=0)
                socket.connect(endpoint)
                self._socket = socket
                self._made.put(None)
                if not self._stopping:
                    self._listen(monitor)
        except zmq.ZMQError as error:  # the last descriptors went to others since they were counted
            self._made.put(LimitReached(f"no connection to the daemon: {error.strerror or error}"))
        except BaseException as error:  # noqa: BLE001  it is raised where the socket is waited for
            self._made.put(error)
        finally:
            self._ended = True
            self._over.put(None)

    def _listen(self, monitor: zmq.Socket[bytes]) -> None:
        while True:
            # zmq.utils.monitor would do this, but loads asyncio (20 ms)
            event, _value = _EVENT.unpack(monitor.recv_multipart()[0])
            if event == zmq.EVENT_MONITOR_STOPPED:
                return
            if event == zmq.EVENT_HANDSHAKE_SUCCEEDED:
                self.handshakes += 1
                self.lost_since = None
                self._connected.put(None)
            elif event == zmq.EVENT_CONNECT_RETRIED:
                self.hung_up = False
            elif event == zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL:
                self.foreign = True
            else:
                self.hung_up = not self.handshakes
                if self.handshakes and self.lost_since is None:
                    self.lost_since = time.monotonic()
                    for queue in tuple(self._waiting):
                        queue.put(None)

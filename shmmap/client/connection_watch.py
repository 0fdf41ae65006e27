# SPDX-License-Identifier: Apache-2.0
"""A connection's socket, and the thread that creates, watches and closes it.

libzmq's objects live in this thread because signal handlers run in the main thread alone: no handler's
exception can leave an unreferenced object behind.  For the same reason a single built-in function starts the
thread, and others wait for it through queues.  The thread blocks signals: the kernel may deliver a signal to
any thread, and a context whose termination is interrupted stays, with a thread and five descriptors.

When the interpreter ends, nothing is closed: another thread may be using the socket, and libzmq aborts the
process if a socket is closed while in use.  Python stops such threads, and the kernel closes the descriptors.

A thread may also outlive its owner.  Finalizers are Python functions, and a signal handler's exception may
interrupt one before it has stopped the thread.  The next connection stops such threads (`stop_orphans`).
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
"""Signals that a thread's own faults cause; they must not be blocked."""
_OPTIONS: Final = ((zmq.LINGER, 0), (zmq.RECONNECT_IVL, 20), (zmq.RECONNECT_IVL_MAX, 500))
"""Options of every socket, milliseconds."""
_LAST_WORDS_MS: Final = 100  # time for a last message to be delivered on closing
CONNECTION: Final = "a connection to the daemon"
FILES: Final = 10
"""Descriptors that libzmq needs (context, socket, monitor, connection), plus one for mapping segments."""
THREADS: Final = 2
"""Threads that libzmq starts for a context, besides the thread that creates it."""
_OVER_S: Final = 0.5  # interval at which a wait for the end checks again, should another thread wait, too


class Running(Protocol):
    """Work that runs in a thread on behalf of an owner."""

    @property
    def owner(self) -> weakref.ref[object]:
        """The object that is responsible for stopping the thread."""

    def request_stop(self) -> None:
        """Ask the thread to end soon."""


running: Final[set[Running]] = set()
"""Work that runs in threads at present; each thread adds and removes its own entry."""


def enter(one: Running) -> None:
    """Register the work of this thread; stop it at once if its owner is already gone."""
    running.add(one)
    if one.owner() is None:
        one.request_stop()


def stop_orphans() -> None:
    """Stop the threads whose owner is gone."""
    for one in tuple(running):
        if one.owner() is None:
            one.request_stop()


def start_thread(run: Callable[..., object], *arguments: object) -> None:
    """Start a thread by a single built-in function: no signal handler can run in the middle.

    Raises
    ------
    LimitReached
        This process may have no more threads.
    SystemExit
        The interpreter is ending and starts no threads; the calling thread ends silently.
    """
    try:
        _thread.start_new_thread(run, arguments)
    except RuntimeError as error:
        if "shutdown" in str(error):  # part of the message since Python 3.12
            raise SystemExit from None
        raise no_threads_left("no thread can be started: ") from None


class ConnectionWatch:
    """One socket, created and closed by a thread, and the state of its connection as libzmq reports it.

    Parameters
    ----------
    owner
        The object that uses the socket and stops the thread.
    endpoint
        Endpoint to which the socket connects.
    options
        Further options of the socket.
    waiting
        Queues that receive None when the connection breaks; may change at any time.
    kind
        Type of socket.

    Attributes
    ----------
    handshakes : int
        Number of times the connection was established.
    lost_since : float or None
        `time.monotonic` when the connection broke; None while it stands, and before it was first established.
    hung_up : bool
        The peer closed the connection before any handshake, and libzmq has not retried yet.
    foreign : bool
        The peer does not speak the expected protocol.

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
        """Socket to send and receive with, for one thread at a time."""
        assert self._socket is not None  # noqa: S101  set before the constructor returns
        return self._socket

    def wait_until_connected(self, timeout_s: float) -> None:
        """Wait for the first handshake."""
        if not self.handshakes:
            with contextlib.suppress(Empty):
                self._connected.get(timeout=max(timeout_s, 0.0))

    def stop(self) -> None:
        """Make the thread close the socket and end; wait for that, unless called in that thread."""
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
        self._stopping = True  # if there is no socket yet, the thread checks this after creating it
        while self._socket is not None and not self._ended and not self._elsewhere:
            try:
                self._socket.disable_monitor()
            except zmq.error.InterruptedSystemCall:
                continue
            except zmq.ZMQError:  # the thread is already ending
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
                # a separate context: no other library's sockets can delay its termination
                context = zmq.Context()
                ends.callback(context.term)
                socket = context.socket(kind)
                ends.callback(socket.close, linger=_LAST_WORDS_MS)
                for option, value in (*_OPTIONS, *options):
                    socket.setsockopt(option, value)
                monitor = socket.get_monitor_socket(_EVENTS)
                ends.callback(monitor.close, linger=0)
                socket.connect(endpoint)
                self._socket = socket
                self._made.put(None)
                if not self._stopping:
                    self._listen(monitor)
        except zmq.ZMQError as error:  # other threads took the last descriptors since they were counted
            self._made.put(LimitReached(f"no connection to the daemon: {error.strerror or error}"))
        except BaseException as error:  # noqa: BLE001  raised again by the thread that waits for the socket
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

# SPDX-License-Identifier: Apache-2.0
"""A connection's socket, and the thread that creates, watches and closes it.

The thread also receives what is not received by the caller itself (`shmmap.client.connection`).

libzmq's objects live in this thread because signal handlers run in the main thread alone: no handler's
exception can leave an unreferenced object behind.  For the same reason a single built-in function starts the
thread, and others wait for it through queues.  The thread blocks signals: the kernel may deliver a signal to
any thread, and a context whose termination is interrupted stays, with a thread and five descriptors.

Locks are taken by ``with lock`` alone.  Python runs signal handlers between interpreter steps; since
``__enter__`` and ``__exit__`` of a lock are built-in functions, a ``with`` calls them and enters or leaves
its block in the same step.  So no handler's exception arrives while the lock is taken outside the block.

When the interpreter ends, nothing is closed: another thread may be using the socket, and libzmq aborts the
process if a socket is closed while in use.  Python stops such threads, and the kernel closes the descriptors.

A thread may also outlive its owner.  Finalizers are Python functions, and a signal handler's exception may
interrupt one before it has stopped the thread.  The next connection stops such threads (`stop_orphans`).
"""

from __future__ import annotations

import _thread
import contextlib
import math
import os
import select
import struct
import threading
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
_WAKE_S: Final = 0.1  # longest wait for another thread that wakes one
_LAST_WORDS_MS: Final = 100  # time for a last message to be delivered on closing
CONNECTION: Final = "a connection to the daemon"
FILES: Final = 11
"""Descriptors of libzmq (context, socket, monitor, connection), one to wake the thread, one for mapping."""
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


class _BriefTurn:
    """A ``with`` that waits at most ``timeout_s`` for its lock; after that, entering raises `StopIteration`.

    Both functions of the protocol are built-in ones here, as they are of the lock itself.
    """

    __slots__ = ("__enter__", "__exit__")

    __enter__: Any
    __exit__: Any

    def __init__(self, lock: threading.Lock, timeout_s: float) -> None:
        # False, after a timeout, is filtered out, and there is no next element
        self.__enter__ = filter(None, map(lock.acquire, (True,), (timeout_s,))).__next__
        self.__exit__ = lock.__exit__


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
    lock : threading.Lock
        Held by the thread that uses the socket.
    serve : callable or None
        What the thread calls when the socket may be readable or writable, after `wake`, and after the seconds
        that the last call returned.  After None the thread does not look at the socket until `wake`.
    handshakes : int
        Number of times the connection was established.
    lost_since : float or None
        `time.monotonic` when the connection broke; None while it stands, and before it was first established.
    hung_up_since : float or None
        `time.monotonic` when the peer closed the connection before any handshake, if libzmq has not retried
        since.
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
        self.lock = threading.Lock()
        self.serve: Callable[[], float | None] | Callable[[], None] | None = None
        self.handshakes = 0
        self.lost_since: float | None = None
        self.hung_up_since: float | None = None
        self.foreign = False
        self._waiting = waiting
        self._pid = os.getpid()
        self._made: SimpleQueue[BaseException | None] = SimpleQueue()
        self._over: SimpleQueue[None] = SimpleQueue()
        self._taking = threading.Lock()
        self._stopping = self._stopped = False
        self._ended = False
        self._thread = 0
        self._waking = threading.Lock()
        self._wake_fd = -1
        self._socket: zmq.Socket[bytes] | None = None
        self._monitor: zmq.Socket[bytes] | None = None
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

    def wake(self) -> None:
        """Have the thread call `serve`."""
        # no lock after a while: of a signal handler that has interrupted just this
        with contextlib.suppress(StopIteration), _BriefTurn(self._waking, _WAKE_S):
            if self._wake_fd >= 0:
                os.eventfd_write(self._wake_fd, 1)

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
                self._monitor = socket.get_monitor_socket(_EVENTS)
                ends.callback(self._monitor.close, linger=0)
                self._wake_fd = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
                ends.callback(self._close_wake)
                socket.connect(endpoint)
                self._socket = socket
                self._made.put(None)
                if not self._stopping:
                    self._listen(socket, self._monitor)
        except zmq.ZMQError as error:  # other threads took the last descriptors since they were counted
            self._made.put(LimitReached(f"no connection to the daemon: {error.strerror or error}"))
        except BaseException as error:  # noqa: BLE001  raised again by the thread that waits for the socket
            self._made.put(error)
        finally:
            self._ended = True
            self._over.put(None)

    def _close_wake(self) -> None:
        with self._waking:
            wake_fd, self._wake_fd = self._wake_fd, -1
            os.close(wake_fd)

    def _listen(self, socket: zmq.Socket[bytes], monitor: zmq.Socket[bytes]) -> None:
        """Take events and serve the socket until the monitor is stopped."""
        poller = select.poll()
        # libzmq signals its descriptors once: afterwards all has to be taken
        monitor_fd, socket_fd = int(monitor.getsockopt(zmq.FD)), int(socket.getsockopt(zmq.FD))
        poller.register(monitor_fd, select.POLLIN)
        poller.register(self._wake_fd, select.POLLIN)
        is_served, ready = False, [monitor_fd]
        while monitor_fd not in ready or self.take_events():
            if self._wake_fd in ready:
                os.eventfd_read(self._wake_fd)
            left_s = self.serve() if self.serve is not None else None
            if self._stopped:
                break
            if is_served != (left_s is not None):
                is_served = not is_served
                if is_served:
                    poller.register(socket_fd, select.POLLIN)
                else:
                    poller.unregister(socket_fd)
            ready = [fd for fd, _ in poller.poll(None if left_s is None else math.ceil(left_s * 1000))]
        self.serve = None

    def take_events(self) -> bool:
        """Take what libzmq has reported; return False when the thread has to end."""
        monitor = self._monitor
        assert monitor is not None  # noqa: S101  it is there before the thread listens
        with self._taking:
            return self._take_from(monitor)

    def _take_from(self, monitor: zmq.Socket[bytes]) -> bool:
        while not self._stopped:
            try:
                # zmq.utils.monitor would do this, but loads asyncio (20 ms)
                event, _value = _EVENT.unpack(monitor.recv_multipart(zmq.DONTWAIT)[0])
            except zmq.Again:
                return True
            if event == zmq.EVENT_MONITOR_STOPPED:
                self._stopped = True
            elif event == zmq.EVENT_HANDSHAKE_SUCCEEDED:
                self.handshakes += 1
                self.lost_since = self.hung_up_since = None
            elif event == zmq.EVENT_CONNECT_RETRIED:
                self.hung_up_since = None
            elif event == zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL:
                self.foreign = True
            elif not self.handshakes:
                self.hung_up_since = time.monotonic()
            elif self.lost_since is None:
                self.lost_since = time.monotonic()
                for queue in tuple(self._waiting):
                    queue.put(None)
        return False

# SPDX-License-Identifier: Apache-2.0
"""One session with the daemon: requests, deadlines, resending, and reconnecting after a restart.

A request travels on a DEALER socket, which reconnects by itself.  Messages in flight are lost when a daemon
is killed.  So a request is sent again, with the same id, as soon as the connection is back, and at intervals
during silence.  Every request may be repeated; replies that no caller waits for any more are dropped.
"""

from __future__ import annotations

import math
import os
import sys
import threading
import time
import weakref
from collections.abc import Callable, Sequence
from queue import SimpleQueue
from typing import Any, Final, TypeVar

import zmq

from shmmap.client.connection_watch import CONNECTION, FILES, ConnectionWatch, stop_orphans
from shmmap.client.discovery import find_socket
from shmmap.errors import (
    BadRequest,
    LimitReached,
    LiveInterrupted,
    NoAnswer,
    ProtocolMismatch,
    ShmmapError,
    error_from_wire,
)
from shmmap.protocol.codec import decode_reply, encode, encode_request
from shmmap.protocol.messages import PROTOCOL_VERSION, ErrorReply, Hello, Reply, Request, Welcome
from shmmap.segment.process_limits import check_files

__all__ = ["SERVED_PAUSE_S", "Connection", "closed", "program_name", "until_served"]

R = TypeVar("R")

_SLICE_MS: Final = 100  # interval at which silence is checked for a broken connection
_RESEND_S: Final = 1.0  # first repetition on silence; the interval then doubles
_QUEUE: Final = 64  # messages that may wait for a slow daemon
_OPTIONS: Final = (
    (zmq.IMMEDIATE, 1),  # nothing queues up for an absent daemon
    (zmq.SNDHWM, _QUEUE),
    (zmq.RCVTIMEO, _SLICE_MS),
)
_SILENT_HINT: Final = "the daemon is stopped, hung, overloaded or gone: see `shmmap health`"
_UPDATE_HINT: Final = "update the older of client and daemon"
_MAX_NAME: Final = 64  # characters of a program's name that the daemon keeps
SERVED_PAUSE_S: Final = 0.05
"""Pause between two tries to reach a live map: no event reports that its process is running again."""


class Connection:
    """A DEALER socket with a session on it; not thread-safe.

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
    welcome : Welcome
        Description of the daemon, as received when the session began.
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
        self._name = name or program_name()
        self._next_request = int.from_bytes(os.urandom(6), "little")
        self._hung_up = False
        self._slot = 0  # kept over restarts of the daemon: mapped segments are locked under it
        self._greeting = True
        stop_orphans()
        self._watch = ConnectionWatch(self, f"ipc://{self.path}", _OPTIONS, waiting)
        # runs also without close(); not at interpreter exit, where threads may still use the socket
        self._finalizer = weakref.finalize(self, self._watch.stop)
        self._finalizer.atexit = False
        self._socket = self._watch.socket
        self._greet(deadline_s)

    def close(self) -> None:
        """End the connection; messages just sent get a short time to be delivered."""
        self._watch.stop()
        self._finalizer.detach()
        stop_orphans()

    @property
    def lost_since(self) -> float | None:
        """`time.monotonic` of when the connection broke; None while it stands."""
        return self._watch.lost_since

    def new_request(self) -> int:
        """Return a request id not used before."""
        self._next_request += 1
        return self._next_request

    def send(self, message: Request) -> None:
        """Send a message without waiting for a reply; it is lost if the daemon is absent."""
        self._send(encode_request(message))

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
            The request is larger than the daemon accepts; nothing was sent.
        NoAnswer
            No reply before the deadline.
        ShmmapError
            The error with which the daemon refused the request.
        """
        try:
            data = encode_request(message)
        except (TypeError, ValueError, OverflowError) as error:
            raise BadRequest(f"the request cannot be sent: {error}") from None
        deadline_s = time.monotonic() + timeout_s
        while True:
            if self._greeting:
                self._greet(deadline_s)
            reply = self._exchange(message.request, data, deadline_s, quiet_s)
            if isinstance(reply, kind):
                return reply
            if reply is None:
                raise self._silence(f"no answer within {timeout_s:.3g} s")
            if not isinstance(reply, ErrorReply):
                raise ProtocolMismatch(
                    f"the daemon answered a request {type(message).__name__} with {type(reply).__name__}",
                    hint=_UPDATE_HINT,
                )
            if reply.code != "no_session":
                raise error_from_wire(reply.code, reply.message, reply.hint)
            self._greet(deadline_s)

    def _greet(self, deadline_s: float) -> None:
        """Begin a session; after an interruption it may be incomplete, and is begun again."""
        started_s = time.monotonic()
        self._greeting = True
        hello = Hello(self.new_request(), *PROTOCOL_VERSION, self._name, self._slot)
        reply = self._exchange(hello.request, encode(hello), deadline_s, 0.0)
        if reply is None:
            raise self._silence(f"connected, but no welcome within {time.monotonic() - started_s:.2g} s")
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
        self._slot = reply.session
        self.welcome: Welcome = reply
        self._watch.wait_until_connected(deadline_s - time.monotonic())  # else it looks like a second time
        self._greeting = False

    def _silence(self, what: str) -> ShmmapError:
        """Return why there is no reply: the daemon's silence, or this process's lack of descriptors."""
        if self._watch.lost_since is not None or not self._watch.handshakes:
            try:
                check_files(1, CONNECTION)
            except LimitReached as limit:
                return limit
        return NoAnswer(f"{self.path}: {what}", hint=_SILENT_HINT)

    def _exchange(self, request: int, data: bytes, deadline_s: float, quiet_s: float) -> Reply | None:
        """Send, and resend, until a reply with this request id arrives; return None at the deadline."""
        sent = False
        watch = self._watch
        handshakes = watch.handshakes
        interval_s = _RESEND_S
        resend_s = 0.0
        while True:
            now_s = time.monotonic()
            if not sent or handshakes != watch.handshakes or now_s >= resend_s:
                handshakes = watch.handshakes
                sent = self._send(data)
                resend_s = now_s + quiet_s + interval_s
                interval_s = interval_s * 2 if sent else interval_s
            if sent:
                reply = self._receive(request, deadline_s)
                if reply is not None:
                    return reply
            else:
                self._socket.poll(_slice_ms(deadline_s), zmq.POLLOUT)
            self._check_peer()
            if time.monotonic() >= deadline_s:
                return None

    def _send(self, data: bytes) -> bool:
        try:
            self._socket.send(data, zmq.DONTWAIT)
        except zmq.Again:
            return False
        return True

    def _receive(self, request: int, deadline_s: float) -> Reply | None:
        """Return the reply to ``request``; None after a slice of silence or at the deadline."""
        while True:
            slice_ms = _slice_ms(deadline_s)
            if slice_ms < _SLICE_MS and not self._socket.poll(slice_ms):
                return None
            try:
                data = self._socket.recv()
            except zmq.Again:
                return None
            reply = decode_reply(data)
            if reply.request == request:
                return reply

    def _check_peer(self) -> None:
        hung_up = self._hung_up
        self._hung_up = self._watch.hung_up
        # libzmq retries after a broken connection, but not if the socket types are incompatible (SUB, for
        # example)
        if self._watch.foreign or (hung_up and self._hung_up):
            raise ProtocolMismatch(
                f"{self.path}: what listens there is no shmmap daemon",
                hint="is this the socket of another program?",
            )


def _slice_ms(deadline_s: float) -> int:
    return max(0, min(_SLICE_MS, math.ceil((deadline_s - time.monotonic()) * 1000)))


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

# SPDX-License-Identifier: Apache-2.0
"""Messages over ZeroMQ: a publisher binds an address, subscribers connect to it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Final

import zmq

from shmmap import BadRequest
from shmmap_clients.closed_at_end import ClosedAtEnd

_REPEAT_MS: Final = 100  # between two repetitions of the end


def is_endpoint(text: str) -> bool:
    """Return whether this is an address, not a file or directory."""
    return "://" in text


class _Endpoint(ClosedAtEnd):
    """A socket of its own kind, in a context of its own."""

    def __init__(self, kind: int) -> None:
        self._context = zmq.Context()
        self._socket: zmq.Socket[bytes] = self._context.socket(kind)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
        self._context.term()


class Publisher(_Endpoint):
    """Publisher that binds an endpoint and sends to all subscribers.

    Parameters
    ----------
    endpoint
        Address to bind, such as ``ipc:///tmp/scans`` or ``tcp://127.0.0.1:5600``.
    queue
        Largest number of messages queued for a slow reader, which misses further ones.
    linger_ms
        Time for `close` to deliver queued messages, and to wait until readers have received the end.

    Raises
    ------
    BadRequest
        The address cannot be bound.
    """

    def __init__(self, endpoint: str, *, queue: int, linger_ms: int) -> None:
        super().__init__(zmq.XPUB)
        self._socket.sndhwm = queue
        self._socket.linger = self._linger_ms = linger_ms
        self._has_subscriber = False
        self._last: Sequence[bytes] | None = None
        try:
            self._socket.bind(endpoint)
        except zmq.ZMQError as error:
            self.close()
            raise BadRequest(f"cannot bind {endpoint}: {error}") from None
        self.endpoint: str = self._socket.getsockopt_string(zmq.LAST_ENDPOINT)

    def wait_for_subscriber(self, timeout_s: float) -> bool:
        """Wait for the first subscriber; return False on timeout."""
        deadline_s = time.monotonic() + timeout_s
        while not self._has_subscriber and self._socket.poll(
            max(0, int((deadline_s - time.monotonic()) * 1000))
        ):
            self._read_subscription()
        return self._has_subscriber

    def publish(self, frames: Sequence[bytes], *, last: bool = False) -> None:
        """Send one message.

        Parameters
        ----------
        frames
            Frames of the message.
        last
            Whether this is the end of the stream, which `close` repeats until no subscriber is left.
        """
        self._last = frames if last else None
        self._socket.send_multipart(frames)

    def close(self) -> None:
        """Deliver queued messages and the end, if any, within ``linger_ms``, and close."""
        deadline_s = time.monotonic() + self._linger_ms / 1000
        while self._last is not None:
            while self._socket.poll(0):
                self._read_subscription()
            if not self._has_subscriber or time.monotonic() >= deadline_s:
                break
            self._socket.send_multipart(self._last)  # in case a slow reader has missed it
            self._socket.poll(_REPEAT_MS)
        super().close()

    def _read_subscription(self) -> None:
        """Record the arrival of the first subscriber, or the departure of the last one."""
        self._has_subscriber = self._socket.recv()[:1] == b"\1"


class Subscriber(_Endpoint):
    """Subscriber to all messages that a publisher sends from now on.

    Parameters
    ----------
    endpoint
        Address of the publisher, which need not run yet.
    queue
        Largest number of messages queued here.

    Raises
    ------
    BadRequest
        The address is invalid.
    """

    def __init__(self, endpoint: str, *, queue: int) -> None:
        super().__init__(zmq.SUB)
        self._socket.rcvhwm = queue
        self._socket.linger = 0
        try:
            self._socket.connect(endpoint)
        except zmq.ZMQError as error:
            self.close()
            raise BadRequest(f"cannot connect to {endpoint}: {error}") from None
        self._socket.subscribe(b"")

    @property
    def closed(self) -> bool:
        """Whether `close` was called."""
        return bool(self._socket.closed)

    def poll(self, timeout_ms: int) -> bool:
        """Wait for a message; return False on timeout."""
        return bool(self._socket.poll(timeout_ms))

    def receive(self) -> list[bytes]:
        """Wait for the next message, and return its frames."""
        return self._socket.recv_multipart()

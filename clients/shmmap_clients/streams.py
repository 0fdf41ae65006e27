# SPDX-License-Identifier: Apache-2.0
"""Messages over ZeroMQ: whoever has something to tell binds an address, whoever wants it subscribes."""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType
from typing import TypeVar

import zmq

from shmmap import BadRequest

__all__ = ["Publisher", "Subscriber", "is_endpoint"]

_Publisher = TypeVar("_Publisher", bound="Publisher")
_Subscriber = TypeVar("_Subscriber", bound="Subscriber")


def is_endpoint(text: str) -> bool:
    """Whether this is an address, not a file or directory."""
    return "://" in text


class Publisher:
    """Binds an endpoint and sends to whoever listens.

    Parameters
    ----------
    endpoint
        Address to bind, such as ``ipc:///tmp/scans`` or ``tcp://127.0.0.1:5600``.
    queue
        How many messages may wait for a slow reader; it misses what comes while so many wait.
    linger_ms
        How long `close` may take to deliver what is queued.

    Raises
    ------
    BadRequest
        The address cannot be bound.
    """

    def __init__(self, endpoint: str, *, queue: int, linger_ms: int) -> None:
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.XPUB)
        self._socket.sndhwm = queue
        self._socket.linger = linger_ms
        try:
            self._socket.bind(endpoint)
        except zmq.ZMQError as error:
            self.close()
            raise BadRequest(f"cannot bind {endpoint}: {error}") from None
        self.endpoint: str = self._socket.getsockopt_string(zmq.LAST_ENDPOINT)

    def __enter__(self: _Publisher) -> _Publisher:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def wait_for_listener(self, timeout_s: float) -> bool:
        """Wait until somebody has subscribed; False if nobody has in time."""
        if not self._socket.poll(int(timeout_s * 1000)):
            return False
        self._socket.recv()
        return True

    def publish(self, frames: Sequence[bytes]) -> None:
        """Send one message."""
        self._socket.send_multipart(frames)

    def close(self) -> None:
        """Deliver what is queued, within the time for that, and close."""
        self._socket.close()
        self._context.term()


class Subscriber:
    """Hears everything that a publisher sends from now on.

    Parameters
    ----------
    endpoint
        The publisher's address; it need not be there yet.
    queue
        How many messages may wait here until they are received.

    Raises
    ------
    BadRequest
        The address makes no sense.
    """

    def __init__(self, endpoint: str, *, queue: int) -> None:
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.SUB)
        self._socket.rcvhwm = queue
        self._socket.linger = 0
        try:
            self._socket.connect(endpoint)
        except zmq.ZMQError as error:
            self.close()
            raise BadRequest(f"cannot connect to {endpoint}: {error}") from None
        self._socket.subscribe(b"")

    def __enter__(self: _Subscriber) -> _Subscriber:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def poll(self, timeout_ms: int) -> bool:
        """Wait until there is a message to receive; False if there was none in time."""
        return bool(self._socket.poll(timeout_ms))

    def receive(self) -> list[bytes]:
        """Return the frames of the next message, when it has come."""
        return self._socket.recv_multipart()

    def close(self) -> None:
        """Stop listening."""
        self._socket.close()
        self._context.term()

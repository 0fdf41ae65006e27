# SPDX-License-Identifier: Apache-2.0
"""The socket that events leave by: XPUB, beside the socket of requests.

Whoever does not keep up loses events and notices by their numbers; nobody is waited for.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import zmq

from shmmap.logfmt import log

__all__ = ["EventPublisher", "events_path"]

QUEUE: Final = 1024
"""Events kept for a subscriber that does not read; further ones are lost to it."""
LAST_WORDS_MS: Final = 100  # the end may take this long to deliver the last events
MAX_SUBSCRIPTION_BYTES: Final = 64
SUBSCRIPTIONS_AT_ONCE: Final = 64


def events_path(request_path: str) -> str:
    """Return where the events of the daemon at this request socket are."""
    return request_path.removesuffix(".sock") + ".events.sock"


class EventPublisher:
    """An XPUB socket; bound by the caller.

    Parameters
    ----------
    on_subscribed
        Called when somebody subscribed; what it sends reaches them.

    Attributes
    ----------
    fd : int
        Readable when `drain` has something to do.
    """

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], on_subscribed: Callable[[], None]) -> None:
        self.socket: zmq.Socket[bytes] = context.socket(zmq.XPUB)
        self.socket.setsockopt(zmq.LINGER, LAST_WORDS_MS)
        self.socket.setsockopt(zmq.SNDHWM, QUEUE)
        self.socket.setsockopt(zmq.MAXMSGSIZE, MAX_SUBSCRIPTION_BYTES)
        # each subscriber is told the last number, not only the first
        self.socket.setsockopt(zmq.XPUB_VERBOSE, 1)
        self.fd = int(self.socket.getsockopt(zmq.FD))
        self._on_subscribed = on_subscribed

    def send(self, data: bytes) -> None:
        """Give an event to all who subscribed and keep up."""
        try:
            self.socket.send(data, zmq.NOBLOCK)
        except zmq.ZMQError as error:
            log.warning("event not sent", error=error)

    def drain(self) -> None:
        """Hear who subscribed; they are told where the numbers stand."""
        subscribed = False
        for _ in range(SUBSCRIPTIONS_AT_ONCE):
            if not self.socket.poll(0):
                break
            subscribed |= self.socket.recv(zmq.NOBLOCK)[:1] == b"\x01"
        if subscribed:
            self._on_subscribed()

    def close(self) -> None:
        """Close it; libzmq removes its file."""
        self.socket.close()

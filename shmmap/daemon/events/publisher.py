# SPDX-License-Identifier: Apache-2.0
"""The socket that events leave by: XPUB, beside the socket of requests.

Whoever does not keep up loses events and notices by their numbers; nobody is waited for.
"""

from __future__ import annotations

import socket
from collections.abc import Callable
from typing import Final

from shmmap.daemon.transport.connection import Connection, Connections, Listener
from shmmap.daemon.transport.watched_descriptors import WatchedDescriptors
from shmmap.statistics.writer import StatisticsWriter

__all__ = ["EventPublisher", "events_path"]

MOST_UNREAD_BYTES: Final = 1 << 20
"""Of events kept for a subscriber that does not read; further ones are lost to it."""
MAX_SUBSCRIPTION_BYTES: Final = 64
_SUBSCRIBE: Final = b"\x01"  # and a prefix


def events_path(request_path: str) -> str:
    """Return where the events of the daemon at this request socket are."""
    return request_path.removesuffix(".sock") + ".events.sock"


class EventPublisher:
    """Sends each event to all who subscribed to everything; nothing else can be subscribed to.

    Parameters
    ----------
    listening
        A socket that listens.
    beat
        Gives what each new subscriber is told first: where the numbers stand.
    """

    def __init__(
        self,
        listening: socket.socket,
        watched: WatchedDescriptors,
        connections: Connections,
        statistics: StatisticsWriter,
        beat: Callable[[], bytes],
    ) -> None:
        self._beat = beat
        self._subscribers: dict[Connection, None] = {}
        self.listener = Listener(
            listening, watched, connections, statistics, b"XPUB", b"SUB", MAX_SUBSCRIPTION_BYTES,
            self._hear, self._leave,
        )  # fmt: skip

    def send(self, data: bytes) -> None:
        """Give an event to all who subscribed and keep up."""
        for one in self._subscribers:
            one.offer(data, MOST_UNREAD_BYTES)

    def _hear(self, connection: Connection, body: bytes, several: bool) -> None:
        if several or body not in (_SUBSCRIBE, b"\x00"):
            connection.cut("it subscribed to some of the events: only all can be subscribed to")
        elif body == _SUBSCRIBE:
            self._subscribers[connection] = None
            connection.offer(self._beat(), MOST_UNREAD_BYTES)
        else:
            self._subscribers.pop(connection, None)

    def _leave(self, connection: Connection) -> None:
        self._subscribers.pop(connection, None)

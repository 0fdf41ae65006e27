# SPDX-License-Identifier: Apache-2.0
"""Connections for tests of what stands on them."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import cast

from shmmap.daemon.transport.connection import Connection, Peer
from shmmap.protocol.events import Event, decode_event

__all__ = ["Subscriber", "of"]


def of(peer: Peer | None = None, reply: Callable[[bytes], None] | None = None) -> Connection:
    """Return what a session knows of its connection: whose it is, and where replies go."""
    return cast("Connection", SimpleNamespace(peer=peer or Peer(), session=None, reply=reply))


class Subscriber:
    """A subscriber of an event log that keeps all events."""

    def __init__(self) -> None:
        self.events: list[Event] = []

    def tell(self, body: bytes, _most_unread_bytes: int) -> None:
        self.events.append(cast("Event", decode_event(body)))

    def take(self) -> list[Event]:
        """Return the events since the last call."""
        events, self.events = self.events, []
        return events

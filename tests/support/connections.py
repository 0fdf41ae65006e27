# SPDX-License-Identifier: Apache-2.0
"""Connections and sessions without sockets."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from types import SimpleNamespace
from typing import cast

from shmmap.daemon.transport.connection import Connection, Peer
from shmmap.daemon.transport.sessions import Session
from shmmap.protocol.events import Event, decode_event
from shmmap.protocol.messages import Intent


def of(peer: Peer | None = None, reply: Callable[[bytes], None] | None = None) -> Connection:
    """Return what a session knows of its connection: whose it is, and where replies go."""
    return cast("Connection", SimpleNamespace(peer=peer or Peer(), slot=0, reply=reply))


def says(session: Session, intent: Intent, now_s: float) -> None:
    """Do what the daemon does when a request with an intent comes."""
    session.state_intent(intent)
    session.last_request_s = now_s


class Subscriber:
    """A subscriber of an event log that keeps all events; ``reads``: whether it takes what it is offered."""

    def __init__(self) -> None:
        self.events: list[Event] = []
        self.reads = True

    def offer(self, bodies: Iterable[bytes]) -> bool:
        self.events += [cast("Event", decode_event(body)) for body in bodies]
        return self.reads

    def take(self) -> list[Event]:
        """Return the events since the last call."""
        events, self.events = self.events, []
        return events

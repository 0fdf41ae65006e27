# SPDX-License-Identifier: Apache-2.0
"""Start and end of sessions: a hello opens one; a goodbye, or the end of the connection, ends it."""

from __future__ import annotations

import contextlib
import itertools
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from shmmap.daemon.cache.holders import Survey, Usage
from shmmap.daemon.events.log import EventLog, MinuteLog
from shmmap.daemon.requests.cell_requests import CellRequests
from shmmap.daemon.requests.operators.operator_requests import OperatorRequests
from shmmap.daemon.transport.connection import Connection
from shmmap.daemon.transport.sessions import Session, Sessions
from shmmap.errors import BadRequest, Busy, ProtocolMismatch
from shmmap.logfmt import log
from shmmap.protocol import events
from shmmap.protocol.messages import PROTOCOL_VERSION, Hello
from shmmap.statistics.writer import StatisticsWriter

LOOKED_AT: Final = 64
"""Departed sessions checked per beat."""


@dataclass(eq=False, slots=True)
class Handshake:
    """Opens and ends sessions.

    Parameters
    ----------
    operators, on_live_session_end
        Notified when a session has ended.
    departures
        Logs how many clients left, one line per minute.
    """

    sessions: Sessions
    cells: CellRequests
    statistics: StatisticsWriter
    event_log: EventLog
    operators: OperatorRequests
    survey: Survey
    on_live_session_end: Callable[[Session], None] = lambda _session: None
    departures: MinuteLog = field(default_factory=MinuteLog)
    _seen: Usage = field(default_factory=Usage)
    _to_check: list[Session] = field(default_factory=list)
    _departed_before: list[Session] = field(default_factory=list)

    def enter(self, connection: Connection, message: Hello, now_s: float) -> Session:
        """Return the session of a client that says hello.

        Raises
        ------
        ProtocolMismatch
            The client speaks another major version of the protocol.
        BadRequest
            There are too many sessions.
        """
        if message.major != PROTOCOL_VERSION[0]:
            hint = "update the client, and restart it; until then it keeps the cells that it has mapped"
            if message.major > PROTOCOL_VERSION[0]:
                hint = "update the daemon, and restart it"
            raise ProtocolMismatch(
                f"client speaks protocol {message.major}.{message.minor},"
                f" daemon {PROTOCOL_VERSION[0]}.{PROTOCOL_VERSION[1]}",
                hint=hint,
            )
        if (session := self.sessions.slots.get(connection.slot)) is not None:
            return session  # a repeated hello: its answer was late or lost
        earlier = self.sessions.slots.get(message.session)
        if earlier is not None and earlier.peer == connection.peer:
            self.sessions.departed.pop(earlier.slot, None)
            earlier.connect(connection)
            return earlier
        if len(self.sessions) >= Sessions.LIMIT:
            spare = self.sessions.spare()
            if spare is None:
                raise BadRequest(f"there are {Sessions.LIMIT} sessions already")
            self.leave(spare)
        session = self.sessions.open(connection, message.client, now_s, slot=message.session)
        self.statistics.add("sessions_opened")
        peer = session.peer
        self.event_log.publish(events.Joined, session.slot, peer.pid, peer.uid, session.client)
        return session

    def hung_up(self, connection: Connection) -> None:
        """Note that a connection has ended; its session ends once the kernel reports that it maps nothing."""
        if (session := self.sessions.slots.get(connection.slot)) is None:
            return
        session.disconnect()
        self.cells.on_disconnect(session)
        self.sessions.departed[session.slot] = session
        if session.held:
            with contextlib.suppress(Busy):  # it waits for many results: `look_after_departed` ends it later
                self.survey.ask(session, lambda usage: self._leave_if_unused(session, usage))
        else:
            self.leave(session)

    def look_after_departed(self) -> None:
        """End departed sessions whose process has exited, or that map nothing according to a later survey."""
        departed = self.sessions.departed
        for slot in list(itertools.islice(departed, LOOKED_AT)):
            session = departed[slot] = departed.pop(slot)  # rotate: the next call begins with others
            if session.peer.pid and not os.path.exists(f"/proc/{session.peer.pid}"):
                self.leave(session)
        if not self._to_check and self.survey.usage is not self._seen:
            self._seen = self.survey.usage
            self._to_check, self._departed_before = self._departed_before, list(departed.values())
        for session in self._to_check[-LOOKED_AT:]:
            self._leave_if_unused(session, self._seen)
        del self._to_check[-LOOKED_AT:]

    def _leave_if_unused(self, session: Session, usage: Usage) -> None:
        known = usage.by_slot or not session.peer.pid  # else the session stays while its process exists
        if known and session.slot in self.sessions.departed and session.slot not in usage.shares:
            self.leave(session)

    def leave(self, session: Session) -> None:
        """End the session of a client that has exited or said goodbye: segments it held may be free now."""
        pid = session.peer.pid
        if session.held:
            log.debug("client left", pid=pid, name=session.client, held_bytes=session.held_bytes)
            self.departures.count("clients left", session.client, session.held_bytes)
        self.event_log.publish(events.Left, session.slot, pid, session.client, session.held_bytes)
        self.sessions.close(session)
        self.cells.on_session_end(session)
        self.operators.on_session_end(session)
        self.on_live_session_end(session)

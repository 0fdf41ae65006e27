# SPDX-License-Identifier: Apache-2.0
"""Clients come and go: a hello opens a session, a goodbye or the end of the client's process ends it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import zmq

from shmmap.daemon.events.log import EventLog
from shmmap.daemon.requests.cell_requests import CellRequests
from shmmap.daemon.requests.operators.operator_requests import OperatorRequests
from shmmap.daemon.transport.inbox import peer_of
from shmmap.daemon.transport.sessions import Session, Sessions
from shmmap.daemon.transport.watched_descriptors import WatchedDescriptors
from shmmap.errors import BadRequest, ProtocolMismatch
from shmmap.logfmt import log
from shmmap.protocol import events
from shmmap.protocol.messages import PROTOCOL_VERSION, Hello
from shmmap.statistics.writer import StatisticsWriter

__all__ = ["Handshake"]

_SOURCE: Final = 2  # ZMQ_SRCFD, deprecated and without a name in pyzmq


@dataclass(eq=False, slots=True)
class Handshake:
    """Opens and ends sessions.

    Parameters
    ----------
    operators
        Told of a session that has ended.
    """

    sessions: Sessions
    cells: CellRequests
    statistics: StatisticsWriter
    event_log: EventLog
    operators: OperatorRequests
    watched: WatchedDescriptors

    def enter(self, identity: bytes, frame: zmq.Frame, message: Hello, now_s: float) -> Session:
        """Return the session of who says hello.

        Raises
        ------
        ProtocolMismatch
            The client speaks another major version of the protocol.
        BadRequest
            There are too many sessions.
        """
        if message.major != PROTOCOL_VERSION[0]:
            raise ProtocolMismatch(
                f"client speaks protocol {message.major}.{message.minor},"
                f" daemon {PROTOCOL_VERSION[0]}.{PROTOCOL_VERSION[1]}",
                hint="update the older of the two",
            )
        peer = peer_of(frame)
        old = self.sessions.by_identity.get(identity)
        if old is not None:
            if old.peer == peer:
                return old  # a repeated hello: its answer was late or lost
            self.leave(old)
        spare = self.sessions.spare() if self.sessions.full else None
        if spare is not None:
            self.leave(spare)
        if self.sessions.full:
            raise BadRequest(f"there are {Sessions.LIMIT} sessions already")
        session = self.sessions.open(identity, peer, message.client, now_s, slot=message.session)
        session.fd = _descriptor(frame)
        self.statistics.add("sessions_opened")
        self.event_log.publish(events.Joined, session.slot, peer.pid, peer.uid, session.client)
        if session.pidfd >= 0:
            self.watched.watch(session.pidfd, lambda: self.leave(session))
        return session

    def leave(self, session: Session) -> None:
        """A client's process ended, or it said goodbye: what it held may be free now."""
        held, pid = session.residents(), session.peer.pid
        if held:
            log.info("client left", pid=pid, name=session.client, held_bytes=session.held_bytes)
        self.event_log.publish(events.Left, session.slot, pid, session.client, session.held_bytes)
        self.cells.forget(session)
        if session.pidfd >= 0:
            self.watched.unwatch(session.pidfd)
        self.sessions.close(session)
        self.cells.let_go(held)
        self.operators.left(session)


def _descriptor(frame: zmq.Frame) -> int:
    """Descriptor of the connection that a message came on; -1 where libzmq does not tell."""
    try:
        return int(frame.get(_SOURCE))
    except zmq.ZMQError:
        return -1

# SPDX-License-Identifier: Apache-2.0
"""Services whose requests one thread takes: it sleeps until one has come, and takes all that have."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from cyclonedds.core import GuardCondition, WaitSet
from cyclonedds.domain import DomainParticipant
from cyclonedds.util import duration

from shmmap_clients.ros_bridge.messages.wire import Damaged
from shmmap_clients.ros_bridge.service_server import Request, ServiceServer

__all__ = ["Listening"]


class Listening:
    """Some services of a participant.

    Parameters
    ----------
    participant
        In whose domain.
    log
        Told of what came and was no request.

    Attributes
    ----------
    servers
        The services.
    """

    def __init__(self, participant: DomainParticipant, log: Callable[[str], None]) -> None:
        self.servers: list[ServiceServer] = []
        self._log = log
        self._waitset = WaitSet(participant)
        self._wake = GuardCondition(participant)
        self._waitset.attach(self._wake)

    def add(self, server: ServiceServer) -> None:
        """Listen to one service more."""
        self.servers.append(server)
        self._waitset.attach(server.condition)

    def wait(self, timeout_s: float) -> None:
        """Sleep until a request has come, or `wake` is called; at most so long."""
        self._waitset.wait(duration(nanoseconds=max(int(timeout_s * 1e9), 0)))

    def wake(self) -> None:
        """Let whoever sleeps, or is going to, go on from now on."""
        self._wake.set(True)

    def take(self) -> Iterator[Request]:
        """Take all requests that have come."""
        for server in self.servers:
            for one in server.take():
                if isinstance(one, Damaged):
                    self._log(f"{server.name}: a request was no message: {one.reason}")
                else:
                    yield one

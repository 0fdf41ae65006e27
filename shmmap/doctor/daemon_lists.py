# SPDX-License-Identifier: Apache-2.0
"""What the statistics lack, because only the daemon lists it: its clients, and the state of its live maps."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from shmmap.errors import ShmmapError
from shmmap.statistics.identity import DaemonIdentity, pid_namespace

if TYPE_CHECKING:
    from shmmap.client.client import Client
    from shmmap.statistics.reader import Snapshot

ANSWER_S: Final = 2.0
"""Seconds that a screen or a check waits for the daemon's answer."""


class DaemonLists:
    """Asks a daemon that answers; the connection is kept for the next time, and made when there is one.

    Parameters
    ----------
    name
        Name of the session in ``shmmap clients``.
    socket
        Socket of a daemon in another container, whose own path means nothing here.
    """

    def __init__(self, name: str = "shmmap", socket: str | None = None) -> None:
        self._name = name
        self._socket = socket
        self._client: Client | None = None

    def close(self) -> None:
        """End the session."""
        client, self._client = self._client, None
        if client is not None:
            client.close()

    def add_to(self, found: Snapshot, *, clients: bool = False) -> None:
        """Add the live maps to the statistics, and on request the clients, but for this session.

        Of a daemon that does not answer there are none.
        """
        identity = found.identity
        if identity is None or found.state != "healthy" or not (clients or identity.live):
            return
        try:
            client = self._connected(identity)
            if identity.live:
                found.live = client.live_maps()
            if clients:
                sessions = client.stats().sessions
                found.clients = [row for row in sessions if row.session != client.welcome.session]
        except ShmmapError:
            self.close()

    def _connected(self, identity: DaemonIdentity) -> Client:
        from shmmap.client.client import connect

        if self._client is None:
            self._client = connect(
                socket_of(identity, self._socket), timeout=ANSWER_S, connect_timeout=ANSWER_S, name=self._name
            )
        return self._client


def socket_of(identity: DaemonIdentity, other: str | None) -> str | None:
    """Return the socket of a daemon by its statistics; ``other`` of one in another container."""
    return identity.endpoint if identity.pid_namespace == pid_namespace() else other

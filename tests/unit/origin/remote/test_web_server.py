# SPDX-License-Identifier: Apache-2.0
"""Connections to a web server that several threads use."""

from __future__ import annotations

from shmmap.origin.remote.store import Timeouts
from shmmap.origin.remote.web_server import _IDLE_CONNECTIONS, _Connection, _Server
from tests.support.interleaving import interleaved

ONCE = Timeouts(connect_s=30.0, read_s=30.0, retries=0, retry_s=0.0)


def idle(count: int) -> _Server:
    """Return a server with connections that were used before."""
    server = _Server("http://localhost", ONCE)
    for _ in range(count):
        server.keep(_Connection(server))
    return server


def test_a_connection_is_taken_by_one_thread() -> None:
    taken: list[tuple[_Connection, bool]] = []

    def take(server: _Server) -> None:
        taken.append(server.connection())

    for _ in interleaved(lambda: idle(1), take, take):
        assert sorted(is_used for _, is_used in taken) == [False, True]
        taken.clear()


def test_no_more_are_kept_than_may_be() -> None:
    def keep(server: _Server) -> None:
        server.keep(_Connection(server))

    for server in interleaved(lambda: idle(_IDLE_CONNECTIONS - 1), keep, keep):
        assert len(server._idle) == _IDLE_CONNECTIONS

# SPDX-License-Identifier: Apache-2.0
"""libzmq's own connections, on a real ROUTER in this process."""

from __future__ import annotations

import select
from collections.abc import Callable
from typing import Any

import zmq

from shmmap.daemon.transport.connections import Census

WAIT_MS = 30_000


class Router:
    """A ROUTER, a loop that a gate can use, and one client."""

    def __init__(self, directory: str) -> None:
        self.path = f"{directory}/s.sock"
        self.context: zmq.Context[Any] = zmq.Context()
        self.socket = self.context.socket(zmq.ROUTER)
        self.socket.bind(f"ipc://{self.path}")
        self.clients: list[Any] = []
        self.epoll = select.epoll()
        self.callbacks: dict[int, Callable[[], None]] = {}

    def watch(self, fd: int, callback: Callable[[], None]) -> None:
        self.callbacks[fd] = callback
        self.epoll.register(fd, select.EPOLLIN)

    def unwatch(self, fd: int) -> None:
        del self.callbacks[fd]
        self.epoll.unregister(fd)

    def connect(self) -> None:
        client = self.context.socket(zmq.DEALER)
        client.linger = 0
        client.connect(f"ipc://{self.path}")
        client.send(b"x")
        self.clients.append(client)

    def hear(self) -> int:
        """Wait for a message; returns the descriptor it came on."""
        assert self.socket.poll(WAIT_MS)
        self.socket.recv()
        return int(self.socket.recv(copy=False).get(2))

    def close(self) -> None:
        for one in (*self.clients, self.socket):
            one.close(linger=0)
        self.context.term()
        self.epoll.close()


def census(router: Router) -> dict[int, list[int]]:
    """Descriptors of all connections, by process."""
    counting = Census([router.path])
    while not counting.step():
        pass
    assert not counting.arriving.total()
    return counting.connections

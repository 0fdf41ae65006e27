# SPDX-License-Identifier: Apache-2.0
"""Requests that wait for their turn: a few of each client, and clients take turns."""

from __future__ import annotations

from collections import OrderedDict
from typing import Final

from shmmap_clients.ros_bridge.service_server import Request

__all__ = ["MOST_OF_ONE", "MOST_WAITING", "WaitingRequests"]

MOST_OF_ONE: Final = 4
"""Of one client: rclcpp nodes have one under way."""
MOST_WAITING: Final = 1024


class WaitingRequests:
    """A queue, for one thread.  Each round has one request of each client that waits."""

    def __init__(self) -> None:
        self._queue: OrderedDict[int, tuple[int, Request]] = OrderedDict()  # by number, with the round
        self._of: dict[str, list[int]] = {}  # numbers by client, the oldest first
        self._next = self._round = 0

    def __len__(self) -> int:
        return len(self._queue)

    def put(self, request: Request) -> bool:
        """Append a request; False if there are too many.  Of one client's the oldest then makes room."""
        mine = self._of.get(request.requester.name, ())
        if len(mine) >= MOST_OF_ONE:
            self._forget(mine[0])
        if len(self._queue) >= MOST_WAITING:
            return False
        last = self._queue[mine[-1]][0] + 1 if mine else self._round
        self._append(max(last, self._round), request)
        return True

    def again(self, request: Request) -> None:
        """Put back what could not be answered yet: every other client comes first."""
        self._append(self._round + 1, request)

    def get(self) -> Request:
        """Take the request whose turn it is; there has to be one."""
        number = min(self._queue, key=lambda one: (self._queue[one][0], one))
        self._round = self._queue[number][0]
        return self._forget(number)

    def _append(self, turn: int, request: Request) -> None:
        self._next += 1
        self._queue[self._next] = turn, request
        self._of.setdefault(request.requester.name, []).append(self._next)

    def _forget(self, number: int) -> Request:
        _, request = self._queue.pop(number)
        name = request.requester.name
        self._of[name].remove(number)
        if not self._of[name]:
            del self._of[name]
        return request

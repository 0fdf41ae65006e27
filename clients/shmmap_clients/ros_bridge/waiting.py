# SPDX-License-Identifier: Apache-2.0
"""Requests that wait for their turn: a few of each client, so that none can push out another's."""

from __future__ import annotations

from collections import Counter, OrderedDict
from typing import Final

from shmmap_clients.ros_bridge.service_server import Request

__all__ = ["MOST_OF_ONE", "MOST_WAITING", "WaitingRequests"]

MOST_OF_ONE: Final = 4
"""Of one client: rclcpp nodes have one under way."""
MOST_WAITING: Final = 1024


class WaitingRequests:
    """A queue, for one thread."""

    def __init__(self) -> None:
        self._queue: OrderedDict[int, Request] = OrderedDict()
        self._of: Counter[str] = Counter()
        self._next = 0

    def __len__(self) -> int:
        return len(self._queue)

    def put(self, request: Request) -> bool:
        """Append a request; False if there are too many.  Of one client's the oldest then makes room."""
        name = request.requester.name
        if self._of[name] >= MOST_OF_ONE:
            self._forget(next(number for number, one in self._queue.items() if one.requester.name == name))
        if len(self._queue) >= MOST_WAITING:
            return False
        self._next += 1
        self._queue[self._next] = request
        self._of[name] += 1
        return True

    def get(self) -> Request:
        """Take the request that waits longest; there has to be one."""
        return self._forget(next(iter(self._queue)))

    def _forget(self, number: int) -> Request:
        request = self._queue.pop(number)
        name = request.requester.name
        self._of[name] -= 1
        if not self._of[name]:
            del self._of[name]
        return request

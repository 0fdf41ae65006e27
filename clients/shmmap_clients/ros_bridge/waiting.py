# SPDX-License-Identifier: Apache-2.0
"""Requests that wait for their turn: a few of each client, so that none can push out another's."""

from __future__ import annotations

import threading
from collections import Counter, OrderedDict
from typing import Final

from shmmap_clients.ros_bridge.service_server import Request

__all__ = ["MOST_OF_ONE", "MOST_WAITING", "WaitingRequests"]

MOST_OF_ONE: Final = 4
"""Of one client: rclcpp nodes have one under way."""
MOST_WAITING: Final = 1024


class WaitingRequests:
    """A queue between the thread that takes requests and one that answers them."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._queue: OrderedDict[int, Request] = OrderedDict()
        self._of: Counter[str] = Counter()
        self._next = 0

    def __len__(self) -> int:
        return len(self._queue)

    def put(self, request: Request) -> bool:
        """Append a request; False if there are too many.  Of one client's the oldest then makes room."""
        name = request.requester.name
        with self._changed:
            if self._of[name] >= MOST_OF_ONE:
                oldest = next(number for number, one in self._queue.items() if one.requester.name == name)
                self._forget(oldest)
            if len(self._queue) >= MOST_WAITING:
                return False
            self._next += 1
            self._queue[self._next] = request
            self._of[name] += 1
            self._changed.notify()
        return True

    def get(self, timeout_s: float) -> Request | None:
        """Take the next request; None when none has come in time, or `wake` was called."""
        with self._changed:
            if not self._queue:
                self._changed.wait(timeout_s)
            if not self._queue:
                return None
            return self._forget(next(iter(self._queue)))

    def wake(self) -> None:
        """Let whoever waits look at what else there is to do."""
        with self._changed:
            self._changed.notify_all()

    def _forget(self, number: int) -> Request:
        request = self._queue.pop(number)
        name = request.requester.name
        self._of[name] -= 1
        if not self._of[name]:
            del self._of[name]
        return request

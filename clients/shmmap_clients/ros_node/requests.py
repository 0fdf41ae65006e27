# SPDX-License-Identifier: Apache-2.0
"""Requests that wait for cells or for the daemon, and the few threads that ask it.

No request holds a thread while its cells load: it is asked for without waiting, which starts the loads, and
comes again after an event of the daemon.  So a request whose cells are in memory waits for no other.
While the daemon is away requests wait, too: an empty answer would be taken for an empty map.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from queue import PriorityQueue
from typing import Any, Final

from shmmap import Client, DaemonUnreachable, ShmmapError
from shmmap.errors import Busy, ProtocolMismatch
from shmmap_clients.ros_cells import LATER, StillLoading

MAX_WAITING: Final = 1024
"""Requests that may wait; above it the oldest, whose client has given up, is answered with nothing."""
_AWAY: Final = (DaemonUnreachable, ProtocolMismatch)
_THREADS: Final = 4


@dataclass(slots=True, eq=False)
class _Request:
    """A request; at ``until_s`` it is answered with the cells that are there."""

    work: Callable[[Client, bool], Any]
    done: Callable[[Any], None]
    until_s: float


class Requests:
    """Threads with a client each, and the table of requests that wait; they end with the process.

    Parameters
    ----------
    connect
        Makes a client.
    wait_s
        Time for the cells of a request to load, seconds, while the daemon is there.
    warn, inform
        Called with a line when the daemon no longer answers, and when it does again.

    Attributes
    ----------
    reachable : bool or None
        Whether the daemon answers; None before it was asked.
    waiting : dict
        Requests that are not answered yet, by number, oldest first.
    """

    def __init__(
        self,
        connect: Callable[[], Client],
        wait_s: float,
        warn: Callable[[str], None],
        inform: Callable[[str], None],
    ) -> None:
        self.reachable: bool | None = None
        self.waiting: dict[int, _Request] = {}
        self._connect, self._wait_s, self._warn, self._inform = connect, wait_s, warn, inform
        self._lock = threading.Lock()
        self._ready: PriorityQueue[tuple[int, int]] = PriorityQueue()  # numbers of requests, new ones first
        self._loading: deque[int] = deque()
        self._count = 0
        for _ in range(_THREADS):
            threading.Thread(target=self._run, daemon=True).start()

    def ask(self, work: Callable[[Client, bool], Any], done: Callable[[Any], None]) -> None:
        """Run ``work`` in a thread until it neither raises `StillLoading` nor misses the daemon.

        Parameters
        ----------
        work
            Called with a client, and whether it is the last time: then it returns what is there.
        done
            Called once, in a thread, with the result or an error.
        """
        with self._lock:
            self._count += 1
            self.waiting[self._count] = _Request(work, done, time.monotonic() + self._wait_s)
            oldest = next(iter(self.waiting)) if len(self.waiting) > MAX_WAITING else 0
        self._ready.put((0, self._count))
        self._finish(oldest, Busy(f"{MAX_WAITING} younger requests wait, too"))

    def ask_again(self) -> None:
        """Ask again for what waits: after an event of the daemon, and now and then."""
        with self._lock:
            for _ in range(len(self._loading)):
                self._ready.put((1, self._loading.popleft()))

    def record(self, error: ShmmapError | None) -> None:
        """Record that the daemon answers, or why it does not; log that if it changes."""
        with self._lock:
            before, self.reachable = self.reachable, error is None
        if error is not None and before is not False:
            self._warn(f"requests wait until the daemon answers: {error}")
        elif error is None and before is False:
            self._inform("the daemon answers again")
            self.ask_again()

    def _run(self) -> None:
        client: Client | None = None
        while True:
            client = self._try(self._ready.get()[1], client)

    def _try(self, number: int, client: Client | None) -> Client | None:
        """Ask for one request; return the client."""
        request = self.waiting.get(number)
        if request is None:
            return client
        try:
            client = client or self._connect()
            result = request.work(client, time.monotonic() >= request.until_s)
        except StillLoading:
            self._loading.append(number)
            self.record(None)
        except ShmmapError as error:
            if client is None or isinstance(error, _AWAY):
                self.record(error)
                request.until_s = time.monotonic() + self._wait_s  # begins when the daemon is back
                self._loading.append(number)
            elif isinstance(error, LATER) and time.monotonic() < request.until_s:
                self._loading.append(number)
            else:
                self._finish(number, error)
        except Exception as error:  # noqa: BLE001  a request that cannot be answered must not end the thread
            self._finish(number, error)
        else:
            self._finish(number, result)
            self.record(None)
        return client

    def _finish(self, number: int, result: Any) -> None:
        with self._lock:
            request = self.waiting.pop(number, None)
        if request is not None:
            request.done(result)

# SPDX-License-Identifier: Apache-2.0
"""Threads that read, write and flush files: what came of it is told in a turn of whoever asked."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import Any, Final, NamedTuple

__all__ = ["CLOSE_S", "FileThreads", "Job"]

THREADS: Final = 4
"""One of them flushes.  More would wait for each other: all that they do between two calls of the kernel
they do one at a time."""
CLOSE_S: Final = 5.0
"""How long files that are being read or written at the end may take: a directory that hangs is left alone."""
FILES_TOGETHER: Final = 8
"""Files that a thread reads or writes, one after the other, until it says so: to be told costs as much."""


class Job(NamedTuple):
    """What a thread does, and what is done with that afterwards, in the next turn."""

    work: Callable[[], Any]
    then: Callable[[Future[Any], float], None]


class FileThreads:
    """Those of one map.

    Parameters
    ----------
    on_done
        Called, in a thread, when there is something to be told.
    threads
        How many there are.
    """

    def __init__(self, on_done: Callable[[], None], threads: int = THREADS) -> None:
        self._threads = ThreadPoolExecutor(threads, "live-files")
        self._running: dict[Future[list[Future[Any]]], list[Job]] = {}
        self._progress_s = 0.0
        self._on_done = on_done

    @property
    def are_idle(self) -> bool:
        """Whether all was done and told."""
        return not self._running

    def idle_s(self, now_s: float) -> float:
        """For how long nothing has been done although something is to be."""
        return now_s - self._progress_s if self._running else 0.0

    def start(self, jobs: list[Job]) -> None:
        """Have them done, several by one thread."""
        for first in range(0, len(jobs), FILES_TOGETHER):
            some = jobs[first : first + FILES_TOGETHER]
            future = self._threads.submit(_outcomes, [job.work for job in some])
            self._running[future] = some
            future.add_done_callback(lambda _future: self._on_done())

    def tell(self, now_s: float) -> None:
        """Tell what came of those that are done."""
        done = [future for future in self._running if future.done()]
        if done or not self._running:
            self._progress_s = now_s
        for future in done:
            for job, outcome in zip(self._running.pop(future), future.result(), strict=True):
                job.then(outcome, now_s)

    def wait(self, seconds: float) -> None:
        """Wait until there is something to tell, at most so long; not at all if nothing is being done."""
        wait(list(self._running), timeout=seconds, return_when=FIRST_COMPLETED)

    def close(self, seconds: float = CLOSE_S) -> list[Any]:
        """Wait until all is done, or time is over; returns what is not reported yet, errors left out."""
        done, _ = wait(list(self._running), timeout=seconds)
        self._threads.shutdown(wait=False, cancel_futures=True)
        untold = [outcome for future in done for outcome in future.result()]
        self._running.clear()
        return [outcome.result() for outcome in untold if outcome.exception() is None]


def _outcomes(works: list[Callable[[], Any]]) -> list[Future[Any]]:
    """Do one after the other; what came of each."""
    found: list[Future[Any]] = []
    for work in works:
        outcome: Future[Any] = Future()
        try:
            outcome.set_result(work())
        except Exception as error:  # noqa: BLE001  told to whoever looks at the outcome
            outcome.set_exception(error)
        found.append(outcome)
    return found

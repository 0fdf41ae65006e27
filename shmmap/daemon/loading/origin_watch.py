# SPDX-License-Identifier: Apache-2.0
"""Watches a remote origin: asks it when loads fail; once it answers again, failed loads are repeated."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from shmmap.daemon.loading.scheduler import Scheduler
from shmmap.daemon.map.origin_link import OriginLink

__all__ = ["OriginWatch"]


@dataclass(eq=False, slots=True)
class OriginWatch:
    """A chore of the serving loop.

    Parameters
    ----------
    try_again
        Has fetched what of the list of cells could not be had.
    reload
        Called when there is another version of the map.
    """

    link: OriginLink
    scheduler: Scheduler
    try_again: Callable[[], None]
    reload: Callable[[], None]

    @property
    def next_s(self) -> float:
        """At once when a load could not read what it needs, or never."""
        failed = self.scheduler.prefetcher.prefetch.health.failed_in_a_row
        return -math.inf if failed and not self.link.is_doubted else math.inf

    def run_step(self, now_s: float) -> None:
        """Find out whether the origin is out of reach."""
        del now_s
        self.link.doubt()

    def collect(self) -> None:
        """Act on what was found out."""
        news = self.link.take()
        health = self.scheduler.prefetcher.prefetch.health
        health.unreachable = self.link.is_out
        if news.back:
            health.failed_in_a_row, health.waited_s = 0, 0.0
            self.scheduler.loads.forget_failures()
            self.scheduler.prefetcher.restart()
            self.try_again()
        if news.changed:
            self.reload()

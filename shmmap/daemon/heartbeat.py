# SPDX-License-Identifier: Apache-2.0
"""The daemon's pulse: a few times a second what it keeps is measured and written to the statistics.

It beats from the serving loop itself, so that whoever is hung does not beat.
"""

from __future__ import annotations

from collections.abc import Callable, Sized
from typing import Final

from shmmap.daemon.store import Store
from shmmap.statistics.writer import StatisticsWriter

__all__ = ["BEAT_S", "Heartbeat"]

BEAT_S: Final = 0.25
CHANGE_BEAT_S: Final = 0.02
USED_ROWS_A_BEAT: Final = 64
"""Rows of the statistics whose hits are brought up to date at a beat: about half a millisecond."""


class Heartbeat:
    """Measures and beats.

    Parameters
    ----------
    sessions, waiting
        Whose lengths are the numbers of clients and of requests that wait for loads.
    on_beat
        Called after each beat.
    """

    def __init__(
        self,
        store: Store,
        statistics: StatisticsWriter,
        *,
        sessions: Sized,
        waiting: Sized,
        on_beat: Callable[[], None],
    ) -> None:
        self._store = store
        self._statistics = statistics
        self._sessions = sessions
        self._waiting = waiting
        self._on_beat = on_beat
        self._last_s = 0.0
        self.next_s = 0.0

    def turn(self, now_s: float) -> None:
        """Beat if it is time to, soon after cells came, went or changed."""
        if self._statistics.outdated:
            # whoever asks right after a change sees it, yet a stream of changes costs little
            self.next_s = min(self.next_s, self._last_s + CHANGE_BEAT_S)
        if now_s >= self.next_s:
            self._last_s, self.next_s = now_s, now_s + BEAT_S
            self._beat()

    def measure(self) -> None:
        """Bring the gauges up to date."""
        books, set_value = self._store.books, self._statistics.set
        set_value("sessions", len(self._sessions))
        set_value("waiting_requests", len(self._waiting))
        set_value("workers", len(self._store.loads.pool))
        set_value("load_queue", books.queued)
        set_value("cells_resident", books.resident_count)
        set_value(
            "stale_cells",
            books.resident_count - books.unchecked_count - sum(map(len, self._store.warm.values())),
        )
        set_value("bytes_resident", books.resident_bytes)
        set_value("zombies", len(books.zombies))
        set_value("bytes_zombie", books.zombie_bytes)
        set_value("bytes_reserved", books.reserved_bytes)
        set_value("bytes_statistics", self._statistics.size_bytes)
        set_value("budget_bytes", books.budget_bytes)
        set_value("evictions", self._store.reclaimer.evicted_count)
        set_value("map_cells", len(self._store.catalogue))

    def _beat(self) -> None:
        self.measure()
        self._store.books.overhead_bytes = self._statistics.size_bytes
        self._store.show_used(USED_ROWS_A_BEAT)
        self._statistics.beat()
        self._on_beat()

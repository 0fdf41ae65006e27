# SPDX-License-Identifier: Apache-2.0
"""What happens to live maps, as events and in the statistics: what changed since the last look."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

from shmmap.daemon.events.log import EventLog
from shmmap.protocol import events
from shmmap.protocol.rows import LiveMapRow
from shmmap.statistics.writer import StatisticsWriter

__all__ = ["LiveEvents"]

_CHUNK: Final = re.compile(r"chunk -?\d+_-?\d+_-?\d+")


@dataclass(eq=False, slots=True)
class LiveEvents:
    """Reports how live maps are, and the process that keeps them.

    Until `begin` nothing is an event: the first one is that of the daemon's start.
    """

    event_log: EventLog
    statistics: StatisticsWriter
    _rows: dict[str, LiveMapRow] = field(default_factory=dict)
    _published: dict[str, LiveMapRow] = field(default_factory=dict)
    _adopted: int = 0
    _begun: bool = False

    def begin(self, maps: int) -> None:
        """Publish events from now on, beginning with how things are with these ``maps`` (their number)."""
        self._begun = True
        self.started(maps, self._adopted)
        self._publish_changes()

    def started(self, maps: int, adopted: int) -> None:
        """Report that the process serves ``maps``, of which ``adopted`` chunks were in memory (numbers)."""
        self._adopted = adopted
        if self._begun:
            self.event_log.publish(events.LiveStarted, maps, adopted)

    def ended(self, restarts: int) -> None:
        """Report that the process ended, for the ``restarts``-th time."""
        self.statistics.set("live_restarts", restarts)
        if self._begun:
            self.event_log.publish(events.LiveEnded, restarts)

    def beat(self) -> None:
        """Write the statistics while the daemon waits for live maps, and its loop does not run yet."""
        self.statistics.beat()

    def update(self, rows: Sequence[LiveMapRow]) -> None:
        """Report how the maps are now."""
        self._rows = {row.name: row for row in rows}
        self.statistics.show_live_maps(rows)
        if self._begun:
            self._publish_changes()

    def _publish_changes(self) -> None:
        """Publish what is different from what was published last."""
        for name, row in self._rows.items():
            before = self._published.get(name)
            known = before.damaged if before is not None else ()
            for what in row.damaged:
                if what not in known:
                    self.event_log.publish(events.LiveDamaged, name, what)
            if _cause(row.problem) != _cause(before.problem if before is not None else ""):
                self.event_log.publish(events.LiveProblem, name, row.problem)
            if before is not None and row.change != before.change:
                self.event_log.mention(events.LiveChanged, name, row.change)
        self._published = self._rows


def _cause(problem: str) -> str:
    """Return what is wrong, whichever chunk met it first."""
    return _CHUNK.sub("chunk", problem)

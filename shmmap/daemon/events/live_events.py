# SPDX-License-Identifier: Apache-2.0
"""Live maps as events and in the statistics: what changed since the last look."""

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
    """Hears how live maps are, and of the process that keeps them, and tells of it.

    Until `begin` nothing is an event: the first one tells of the daemon's start.
    """

    event_log: EventLog
    statistics: StatisticsWriter
    _rows: dict[str, LiveMapRow] = field(default_factory=dict)
    _told: dict[str, LiveMapRow] = field(default_factory=dict)
    _adopted: int = 0
    _begun: bool = False

    def begin(self, maps: int) -> None:
        """Tell events from now on, beginning with how things are with so many maps."""
        self._begun = True
        self.started(maps, self._adopted)
        self._tell()

    def started(self, maps: int, adopted: int) -> None:
        """The process serves so many maps, of which so many chunks were in memory."""
        self._adopted = adopted
        if self._begun:
            self.event_log.publish(events.LiveStarted, maps, adopted)

    def ended(self, restarts: int) -> None:
        """The process ended, for the ``restarts``-th time."""
        self.statistics.set("live_restarts", restarts)
        if self._begun:
            self.event_log.publish(events.LiveEnded, restarts)

    def beat(self) -> None:
        """Write the statistics while the daemon waits for live maps, and its loop does not run yet."""
        self.statistics.beat()

    def told(self, rows: Sequence[LiveMapRow]) -> None:
        """This is how the maps are now."""
        self._rows = {row.name: row for row in rows}
        self.statistics.show_live_maps(rows)
        if self._begun:
            self._tell()

    def _tell(self) -> None:
        """Tell what is different from what was told last."""
        for name, row in self._rows.items():
            before = self._told.get(name)
            known = before.damaged if before is not None else ()
            for what in row.damaged:
                if what not in known:
                    self.event_log.publish(events.LiveDamaged, name, what)
            if _cause(row.problem) != _cause(before.problem if before is not None else ""):
                self.event_log.publish(events.LiveProblem, name, row.problem)
            if before is not None and row.change != before.change:
                self.event_log.mention(events.LiveChanged, name, row.change)
        self._told = self._rows


def _cause(problem: str) -> str:
    """What is wrong, whichever chunk met it first."""
    return _CHUNK.sub("chunk", problem)

# SPDX-License-Identifier: Apache-2.0
"""Telling of cells that clients on their way had to wait for: of each client at most once a second."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from itertools import islice
from typing import Final

from shmmap.daemon.events.log import EventLog
from shmmap.daemon.transport.sessions import Session
from shmmap.protocol import events

__all__ = ["LateCells"]

LATE_S: Final = 1.0
MOST_AT_ONCE: Final = 16
"""Clients told of, or looked at, in one turn: many of them must not drive all else out of the log."""


@dataclass(eq=False, slots=True)
class _Waited:
    """What is not told yet of one client, and until when nothing is."""

    session: int
    pid: int
    client: str
    cells: int = 0
    cell_id: str = ""
    layer: str = ""
    quiet_until_s: float = float("-inf")


class LateCells:
    """Remembers who had to wait until it is told; a client's end changes nothing of that."""

    def __init__(self, log: EventLog) -> None:
        self._log = log
        self._waited: OrderedDict[int, _Waited] = OrderedDict()  # by session, whose turn is next first

    def __len__(self) -> int:
        """How many clients are remembered."""
        return len(self._waited)

    def note(self, session: Session, count: int, cell_id: str, layer: str) -> None:
        """A client has to wait for some cells; ``cell_id`` is one of them, as replies carry it."""
        one = self._waited.get(session.slot)
        if one is None:
            name = session.client or session.command
            one = self._waited[session.slot] = _Waited(session.slot, session.peer.pid, name)
        one.cells += count
        one.cell_id, one.layer = cell_id, layer

    def turn(self, now_s: float) -> None:
        """Tell of some clients, those first that have waited longest for it."""
        for slot, one in list(islice(self._waited.items(), MOST_AT_ONCE)):
            if now_s < one.quiet_until_s:
                self._waited.move_to_end(slot)
            elif one.cells:
                self._log.publish(
                    events.Late, one.session, one.pid, one.client, one.cells, one.cell_id, one.layer
                )
                one.cells, one.quiet_until_s = 0, now_s + LATE_S
                self._waited.move_to_end(slot)
            else:
                del self._waited[slot]

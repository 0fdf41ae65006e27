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
MOST_CELLS: Final = 1 << 12
MOST_CLIENTS: Final = 1 << 8
"""Cells that somebody waits for, and clients that wait for one, of which that is remembered."""


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
    """Remembers who had to wait until it is told; a client's end changes nothing of that.

    Who asks again for a cell that has not come meanwhile waits on, and that is no other wait.
    """

    def __init__(self, log: EventLog) -> None:
        self._log = log
        self._absent: OrderedDict[tuple[str, str], set[int]] = OrderedDict()  # who waits for it
        self._waited: OrderedDict[int, _Waited] = OrderedDict()  # by session, whose turn is next first

    def __len__(self) -> int:
        """How many clients are remembered."""
        return len(self._waited)

    def arrived(self, cell_id: str, layer: str) -> None:
        """Nobody waits for a cell any more."""
        self._absent.pop((cell_id, layer), None)

    def note(self, session: Session, cell_id: str, layer: str) -> bool:
        """A client has to wait for a cell; False if it does so already.

        Parameters
        ----------
        cell_id
            As replies carry it.
        """
        waiting = self._absent.setdefault((cell_id, layer), set())
        if session.slot in waiting:
            return False
        if len(waiting) >= MOST_CLIENTS:
            waiting.clear()
        waiting.add(session.slot)
        if len(self._absent) > MOST_CELLS:
            self._absent.popitem(last=False)
        one = self._waited.get(session.slot)
        if one is None:
            name = session.client or session.command
            one = self._waited[session.slot] = _Waited(session.slot, session.peer.pid, name)
        one.cells += 1
        one.cell_id, one.layer = cell_id, layer
        return True

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

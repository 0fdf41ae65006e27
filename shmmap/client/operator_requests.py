# SPDX-License-Identifier: Apache-2.0
"""What a client asks about the daemon and of it, rather than of its map: mostly for operators."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

from shmmap.client.arguments import names
from shmmap.client.session import Session
from shmmap.protocol import messages

__all__ = ["OperatorRequests"]

RELOAD_S: Final = 60.0
RELOAD_CELL_S: Final = 60e-6
"""How long reading a map's catalogue may take, in all and for each cell, beside what any request may."""


class OperatorRequests:
    """The part of `shmmap.Client` that looks at the daemon and directs it."""

    def __init__(self, session: Session) -> None:
        self._session = session

    def stats(self) -> messages.StatsReply:
        """Return the daemon's counters, its sessions, and memory that processes without a session use."""
        return self._session.ask(messages.Stats, messages.StatsReply)

    def show(self, cell: str) -> messages.ShownCell:
        """Return everything about one cell: versions, segments and who uses them, last failure.

        Raises
        ------
        UnknownCell
            The map has no such cell.
        """
        return self._session.ask(lambda n: messages.Show(n, cell), messages.ShownCell)

    def reload(self) -> messages.Reloaded:
        """Have the daemon read the map's directory again.

        That may take a minute more than other requests, and another one for every million cells: all files
        are looked at.

        Raises
        ------
        NotPermitted
            The daemon lets only administrators do this.
        """
        most_s = RELOAD_S + RELOAD_CELL_S * self._session.welcome.cells
        return self._session.ask(messages.Reload, messages.Reloaded, quiet_s=most_s)

    def evict(self, ids: str | Iterable[str] | None = None) -> messages.Evicted:
        """Have the daemon drop cells, all by default; those in use are freed when they are let go.

        Raises
        ------
        NotPermitted
            The daemon lets only administrators do this.
        """
        wanted = names("ids", ids) if ids is not None else None
        return self._session.ask(lambda n: messages.Evict(n, wanted), messages.Evicted)

    def pin(
        self, ids: str | Iterable[str] = (), layers: str | Sequence[str] = ("points",)
    ) -> messages.Pinned:
        """Have the daemon keep cells in memory, until `unpin` or its end; without ids, list its pins.

        Raises
        ------
        NotPermitted
            The daemon lets only administrators do this.
        OverBudget
            All pins together would exceed the budget.
        """
        wanted, specs = names("ids", ids), names("layers", layers)
        return self._session.ask(lambda n: messages.Pin(n, wanted, specs), messages.Pinned)

    def unpin(self, ids: str | Iterable[str] | None = None) -> messages.Pinned:
        """Have the daemon keep cells, all by default, no longer; returns what stays pinned.

        Raises
        ------
        NotPermitted
            The daemon lets only administrators do this.
        """
        wanted = names("ids", ids) if ids is not None else None
        return self._session.ask(lambda n: messages.Unpin(n, wanted), messages.Pinned)

    def shutdown(self) -> None:
        """End the daemon, as SIGTERM would; what is mapped stays readable.

        Raises
        ------
        NotPermitted
            The daemon lets only administrators do this.
        """
        self._session.ask(messages.Shutdown, messages.Stopping)

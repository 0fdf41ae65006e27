# SPDX-License-Identifier: Apache-2.0
"""How much memory is mapped by somebody, counted a few segments at a time.

Only the kernel knows, and asking it takes some 15 us a segment; so each beat looks at a few, those
of the last round first come first served, and the sums are as old as one round.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from shmmap.daemon.records import Resident

__all__ = ["PinCensus"]


class PinCensus:
    """Keeps the sums up to date.

    Parameters
    ----------
    everything
        Gives all segments in memory, retired ones included.
    is_pinned
        The kernel's word on one of them; None if its name is gone.

    Attributes
    ----------
    pinned_bytes, pinned_count
        What was mapped when last looked at.
    """

    def __init__(
        self,
        everything: Callable[[], Iterable[Resident]],
        is_pinned: Callable[[Resident], bool | None],
    ) -> None:
        self._everything = everything
        self._is_pinned = is_pinned
        self._pinned: dict[str, int] = {}
        self._round: list[Resident] = []
        self.pinned_bytes = 0

    @property
    def pinned_count(self) -> int:
        """How many segments were mapped when last looked at."""
        return len(self._pinned)

    def look(self, limit: int) -> None:
        """Ask the kernel about at most ``limit`` segments, and begin a new round after the last."""
        if not self._round:
            self._begin_round()
        for _ in range(min(limit, len(self._round))):
            resident = self._round.pop()
            self._note(resident.name, resident.nbytes if self._is_pinned(resident) else 0)

    def _begin_round(self) -> None:
        self._round = list(self._everything())
        names = {resident.name for resident in self._round}
        for name in [name for name in self._pinned if name not in names]:
            self._note(name, 0)

    def _note(self, name: str, nbytes: int) -> None:
        self.pinned_bytes += nbytes - self._pinned.pop(name, 0)
        if nbytes:
            self._pinned[name] = nbytes

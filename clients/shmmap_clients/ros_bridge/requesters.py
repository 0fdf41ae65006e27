# SPDX-License-Identifier: Apache-2.0
"""Which version of each cell every client has: Autoware's request names cells, but not their versions.

So a file that has changed would never reach a client that has its cell already. This remembers what each
client was sent, and a changed cell is sent to it again under its id.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Collection, Iterable, Mapping
from typing import Final, TypeAlias

__all__ = ["MOST_REQUESTERS", "Requesters"]

Versioned: TypeAlias = tuple[str, int | None]
"""The id of a cell and its version; None: the current one."""

MOST_REQUESTERS: Final = 256
"""So many clients are remembered: then the one that has not asked for longest is forgotten."""


class Requesters:
    """Versions by client and cell.

    Parameters
    ----------
    most
        How many clients are remembered.
    """

    def __init__(self, most: int = MOST_REQUESTERS) -> None:
        self._most = most
        self._versions: OrderedDict[str, dict[str, int]] = OrderedDict()

    def __len__(self) -> int:
        return len(self._versions)

    def held(self, requester: str, ids: Iterable[str], current: Mapping[str, int]) -> list[Versioned]:
        """Return what a client has: ids with versions.

        Parameters
        ----------
        requester
            Who it is.
        ids
            What it says it has.
        current
            Versions that cells have now: what was not sent by us counts as current, as it does in Autoware.

        Returns
        -------
        One for each id, also for those that nobody knows: in the order given, without repetitions.
        """
        known = self._versions.get(requester, {})
        return [(one, known.get(one, current.get(one))) for one in dict.fromkeys(ids)]

    def answered(
        self, requester: str, held: Iterable[Versioned], removed: Collection[str], sent: Mapping[str, int]
    ) -> None:
        """Remember what a client has after an answer.

        Parameters
        ----------
        held, removed, sent
            What it had; what it was told to drop; the versions of what it was sent.
        """
        gone = set(removed)
        versions = {one: version for one, version in held if version is not None and one not in gone}
        versions.update(sent)
        self._versions[requester] = versions
        self._versions.move_to_end(requester)
        while len(self._versions) > self._most:
            self._versions.popitem(last=False)

    def keep_only(self, alive: Collection[str]) -> None:
        """Forget every client that is not among these."""
        for requester in [one for one in self._versions if one not in alive]:
            del self._versions[requester]

# SPDX-License-Identifier: Apache-2.0
"""The map's cells as the bridge knows them, and which version of each every client has.

Autoware's request names cells, but not their versions: a file that has changed would never reach a client
that has its cell already.  So the bridge remembers what each client was sent, and sends a changed cell again
under its id.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Collection, Iterable, Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap import CellInfo, Client
from shmmap_clients.ros_bridge.cdr import CdrWriter, Content

__all__ = ["MAX_REQUESTERS", "Catalogue", "Requesters"]

MAX_REQUESTERS: Final = 256
"""Clients that are remembered; beyond that, the one with the oldest request is forgotten."""


class Catalogue:
    """Cells by id, of one map version.

    Attributes
    ----------
    cells : dict
        `shmmap.CellInfo` by id, in the order of ids.
    versions : dict
        Version of each cell's points by id.
    map_version : int or None
        Which state of the map this is; None before the first `refresh`.
    """

    def __init__(self) -> None:
        self.cells: dict[str, CellInfo] = {}
        self.versions: dict[str, int] = {}
        self.map_version: int | None = None

    def refresh(self, client: Client) -> None:
        """Fetch what has changed.

        Raises
        ------
        DaemonUnreachable
            The daemon does not answer.
        """
        listing = client.metadata(since=self.map_version)
        if listing.map_version == self.map_version:
            return
        changed = {cell.id: cell for cell in listing}
        cells = {**self.cells, **changed} if listing.since_known else changed
        for gone in listing.removed if listing.since_known else ():
            cells.pop(gone, None)
        self.cells = dict(sorted(cells.items()))
        self.versions = {cell.id: cell.version for cell in self.cells.values()}
        self.map_version = listing.map_version

    def boxes(self) -> NDArray[np.float64]:
        """Return all boxes, (N, 4) min_x min_y max_x max_y, metres, in the order of ids."""
        return np.array([cell.box for cell in self.cells.values()], np.float64).reshape(-1, 4)

    def message(self, frame_id: str, stamp_ns: int) -> Content:
        """Return the list as ``autoware_map_msgs/PointCloudMapMetaData``."""
        writer = CdrWriter()
        writer.int32(stamp_ns // 10**9)
        writer.uint32(stamp_ns % 10**9)
        writer.text(frame_id)
        writer.uint32(len(self.cells))
        for cell in self.cells.values():
            writer.text(cell.id)
            writer.float32(*cell.box)
        return writer.content()


class Requesters:
    """Versions by client and cell.

    Parameters
    ----------
    most
        How many clients are remembered.
    """

    def __init__(self, most: int = MAX_REQUESTERS) -> None:
        self._most = most
        self._versions: OrderedDict[str, dict[str, int]] = OrderedDict()

    def __len__(self) -> int:
        return len(self._versions)

    def held(
        self, requester: str, ids: Iterable[str], current: Mapping[str, int]
    ) -> list[tuple[str, int | None]]:
        """Return what a client has: ids with versions.

        Parameters
        ----------
        requester
            The client.
        ids
            What it says it has.
        current
            Versions that cells have now: what was not sent by us counts as current, as it does in Autoware.

        Returns
        -------
        One for each id, unknown ones included: in the order given, without repetitions.
        """
        known = self._versions.get(requester, {})
        return [(one, known.get(one, current.get(one))) for one in dict.fromkeys(ids)]

    def answered(
        self,
        requester: str,
        held: Iterable[tuple[str, int | None]],
        removed: Collection[str],
        sent: Mapping[str, int],
    ) -> None:
        """Remember what a client has after an answer.

        Parameters
        ----------
        held, removed, sent
            What it had; what it was asked to drop; the versions of what it was sent.
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

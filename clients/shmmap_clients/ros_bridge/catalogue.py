# SPDX-License-Identifier: Apache-2.0
"""The map's list of cells as the bridge knows it, kept up by asking the daemon what has changed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from shmmap import CellInfo, Client
from shmmap_clients.ros_bridge.cdr import CdrWriter, Content

__all__ = ["Catalogue"]


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
        """Take in what has changed.

        Raises
        ------
        DaemonUnreachable
            Nobody answers.
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

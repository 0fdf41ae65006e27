# SPDX-License-Identifier: Apache-2.0
"""Where the cells lie that cannot be had: replies name them, only the map's list says where they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeAlias

from shmmap import geometry
from shmmap.client.client import Client
from shmmap.errors import CellError, ShmmapError

__all__ = ["FailedBoxes"]

Box: TypeAlias = tuple[float, float, float, float]


class FailedBoxes:
    """Boxes of failed cells; asks for them once for each cell and state of the map."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._map_version = 0
        self._sought: set[str] = set()
        self._boxes: dict[str, Box] = {}

    def of(self, failed: Sequence[CellError], area: geometry.Area, map_version: int) -> Mapping[str, Box]:
        """Return box by id, (min_x, min_y, max_x, max_y) in metres; a cell nobody knows of is left out.

        Parameters
        ----------
        failed
            Cells that touch ``area`` and cannot be had.
        map_version
            State of the map that the answer was about.
        """
        if map_version != self._map_version:
            self._map_version = map_version
            self._sought.clear()
            self._boxes.clear()
        ids = {failure.cell_id for failure in failed}
        if not ids <= self._sought:
            self._sought |= ids
            try:
                listing = self._client.metadata(area)
            except ShmmapError:  # not where they lie, then: whoever asks must take them to be near
                self._sought -= ids
            else:
                self._boxes.update((cell.id, cell.box) for cell in listing if cell.id in ids)
        return {cell_id: self._boxes[cell_id] for cell_id in ids if cell_id in self._boxes}

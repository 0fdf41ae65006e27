# SPDX-License-Identifier: Apache-2.0
"""From a reply's handles to attached cells; what went stale on the way is asked for again."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from typing import Final

from shmmap.client.cell import Cell
from shmmap.client.cell_set import CellSet, PendingLayer, cell_error
from shmmap.client.connection import Connection
from shmmap.errors import CellError, LoadFailed, SegmentCorrupt, StaleHandle
from shmmap.protocol import messages
from shmmap.protocol.messages import Handle

__all__ = ["Answer"]

_LONGEST_WAIT_S: Final = 5.0


class Answer:
    """Cells of one answer while they are attached, each at its place in the reply.

    Parameters
    ----------
    attach
        Makes a cell of a handle; `StaleHandle` and `SegmentCorrupt` cost that cell only.
    whole_id
        Makes a cell's id of what replies carry.

    Attributes
    ----------
    gone : list
        Places and handles whose segments were gone before they could be attached.
    """

    def __init__(self, attach: Callable[[Handle], Cell], whole_id: Callable[[str], str]) -> None:
        self._attach = attach
        self._whole = whole_id
        self._cells: dict[int, Cell] = {}
        self._failed: list[CellError] = []
        self._pending: list[PendingLayer] = []
        self.gone: list[tuple[int, Handle]] = []

    def take(self, reply: messages.Cells, places: Iterable[int]) -> None:
        """Attach a reply's handles at these places; note what went stale meanwhile and what failed."""
        for place, handle in zip(places, reply.cells, strict=True):
            try:
                self._cells[place] = self._attach(handle)
            except StaleHandle:  # noqa: PERF203  one cell must not cost the others
                self.gone.append((place, handle))
            except SegmentCorrupt as error:
                cell_id = self._whole(handle.id)
                message = f"{cell_id} ({handle.layer}): {error}"
                box = (handle.min_x, handle.min_y, handle.max_x, handle.max_y)
                failure = LoadFailed(message, cell_id=cell_id, layer=handle.layer, box=box)
                failure.__cause__ = error
                self._failed.append(failure)
        whole = self._whole
        self._pending += [PendingLayer(whole(cell.id), cell.layer) for cell in reply.pending]
        self._failed += [
            cell_error(cell, cell.id if cell.code == "unknown_cell" else whole(cell.id))
            for cell in reply.failed
        ]

    def ask_again(self, connection: Connection, deadline_s: float) -> None:
        """Ask anew for the handles whose segments were gone before they could be attached."""
        gone, self.gone = self.gone, []
        places: dict[tuple[str, str], list[int]] = {}
        for place, handle in gone:
            places.setdefault((handle.id, handle.layer), []).append(place)
        timeout_s = max(deadline_s - time.monotonic(), 1e-3)
        message = messages.Selected(
            connection.new_request(),
            tuple(dict.fromkeys(cell_id for cell_id, _ in places)),
            tuple(dict.fromkeys(layer for _, layer in places)),
            min(timeout_s / 2, _LONGEST_WAIT_S),
        )
        reply = connection.ask(message, messages.Cells, timeout_s=timeout_s, quiet_s=timeout_s / 2)
        wanted = [handle for handle in reply.cells if (handle.id, handle.layer) in places]
        repeated = [(place, handle) for handle in wanted for place in places[handle.id, handle.layer]]
        answer = messages.Cells(
            reply.request,
            reply.epoch,
            reply.map_version,
            cells=tuple(handle for _, handle in repeated),
            pending=tuple(cell for cell in reply.pending if (cell.id, cell.layer) in places),
            failed=tuple(cell for cell in reply.failed if (cell.id, cell.layer) in places),
        )
        self.take(answer, [place for place, _ in repeated])

    def result(
        self,
        reply: messages.Cells,
        removed: Callable[[Sequence[str], bytes], tuple[str, ...]] | None,
    ) -> CellSet:
        """Return the answer; what is still gone counts as pending."""
        self._pending += [PendingLayer(self._whole(handle.id), handle.layer) for _, handle in self.gone]
        return CellSet(
            tuple(self._cells[place] for place in sorted(self._cells)),
            tuple(self._failed),
            tuple(self._pending),
            removed(reply.removed, reply.removed_packed) if removed is not None else (),
            reply.epoch,
            reply.map_version,
            reply.layers,
            reply.covered,
            reply.reason,
        )

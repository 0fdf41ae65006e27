# SPDX-License-Identifier: Apache-2.0
"""Answers to Autoware's three requests for cells, as its map loader gives them.

- Partial and differential answers are in the order of ids, selected ones in the order asked for, with
  repetitions; an unknown id is left out.
- ``ids_to_remove`` has what the client said it has and does not need any more, unknown ids included, in the
  order given.
- The header's frame is the map's, its time is zero; the header of each cloud is empty.

Different, because the message says nothing of it: a cell that cannot be loaded is left out, where Autoware
sends it empty and the client believes that nothing is there; an id that was given twice is not removed for
being there twice; and a cell whose file has changed since the client got it is sent again.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Hashable, Iterable, Sequence
from typing import Any, Final

from shmmap import Cell, CellSet, Client
from shmmap_clients.ros_bridge.areas import sensible, touches
from shmmap_clients.ros_bridge.catalogue import Catalogue
from shmmap_clients.ros_bridge.cdr import CdrWriter, Content
from shmmap_clients.ros_bridge.messages.autoware import GetDifferentialRequest, GetPartialRequest
from shmmap_clients.ros_bridge.point_cloud import CloudLayout, cloud_layout, write_cloud
from shmmap_clients.ros_bridge.recent_cells import RecentCells
from shmmap_clients.ros_bridge.requesters import Requesters

__all__ = ["MapAnswers"]

_PAUSE_S: Final = 0.2
_NAMED: Final = 3
_REUSED_BYTES: Final = 16 << 20
_LAYOUTS: Final = 64

Log = Callable[[str], None]


class MapAnswers:
    """Answers requests with the daemon's cells.

    Parameters
    ----------
    client
        Of the daemon.
    catalogue
        The map's list.
    requesters
        What each client has.
    wait_s
        How long the daemon may take to load what is not in memory; what is missing then is left out.
    log
        Told what is left out.
    """

    def __init__(
        self, client: Client, catalogue: Catalogue, requesters: Requesters, wait_s: float, log: Log
    ) -> None:
        self._client = client
        self._catalogue = catalogue
        self._requesters = requesters
        self._wait_s = wait_s
        self._log = log
        self._recent = RecentCells()
        self._layouts: dict[Hashable, CloudLayout] = {}
        self._sent: Content | None = None  # the reply before: its memory is used again

    def answer(self, message: Any, requester: str) -> tuple[Content, Callable[[], None]]:
        """Return a reply, and what to call when it was sent.

        It has to be sent before the next one is asked for.

        Raises
        ------
        ShmmapError
            The daemon does not answer, or refuses; nothing has changed then.
        ValueError
            The reply is larger than DDS can send.
        """
        if isinstance(message, GetDifferentialRequest):
            return self._differential(message, requester)
        if isinstance(message, GetPartialRequest):
            area = sensible(message.area)
            if area is not None:
                cells = self._all(lambda wait: self._client.area(area, wait=wait, strict=None))
            else:
                cells = self._selected(self._touched(message.area))
        else:
            cells = self._selected(message.cell_ids)
        return self._reply(message, cells), _nothing

    def empty(self, message: Any) -> Content:
        """Return the reply that has nothing, for a request that the daemon refuses."""
        return self._reply(message, ())

    def _differential(
        self, message: GetDifferentialRequest, requester: str
    ) -> tuple[Content, Callable[[], None]]:
        held = self._requesters.held(requester, message.cached_ids, self._catalogue.versions)
        area = sensible(message.area)
        if area is not None:
            found = self._all(lambda wait: self._client.differential(area, held, wait=wait, strict=None))
            cells: Sequence[Cell] = found
            removed: Collection[str] = found.removed
        else:
            wanted = self._touched(message.area)
            versions = {one.id: one.version for one in held}
            current = self._catalogue.versions
            cells = self._selected([one for one in wanted if versions.get(one) != current[one]])
            removed = [one.id for one in held if one.id not in set(wanted)]
        sent = {cell.id: cell.version for cell in cells}

        def done() -> None:
            self._requesters.answered(requester, held, removed, sent)

        return self._reply(message, cells, removed), done

    def _touched(self, area: Any) -> list[str]:
        self._catalogue.refresh(self._client)
        inside = touches(area, self._catalogue.boxes())
        return [one for one, take in zip(self._catalogue.cells, inside, strict=True) if take]

    def _selected(self, ids: Sequence[str]) -> CellSet:
        if not ids:
            return CellSet()
        return self._all(lambda wait: self._client.selected(ids, wait=wait, strict=None))

    def _all(self, ask: Callable[[float], CellSet]) -> CellSet:
        """Ask until the daemon knows what there is; what is missing is told."""
        until_s = time.monotonic() + self._wait_s
        cells = ask(self._wait_s)
        while not cells.covered and time.monotonic() + _PAUSE_S < until_s:
            time.sleep(_PAUSE_S)
            cells = ask(max(until_s - time.monotonic(), 0.0))
        missing = [str(error) for error in cells.failed]
        missing += [f"{one.id}: not loaded after {self._wait_s:g} s" for one in cells.pending]
        if missing:
            more = f"; and {len(missing) - _NAMED} more" if len(missing) > _NAMED else ""
            self._log(f"left out of an answer: {'; '.join(missing[:_NAMED])}{more}")
        return cells

    def let_go(self) -> None:
        """Let go of cells that nobody has asked for lately."""
        if self._recent.let_go():
            self._client.release()

    def _reply(self, message: Any, cells: Iterable[Cell], removed: Collection[str] | None = None) -> Content:
        writer = CdrWriter()
        writer.uint64(message.client)
        writer.int64(message.number)
        writer.int32(0)
        writer.uint32(0)
        writer.text(self._client.welcome.frame_id)
        self._write_cells(writer, self._recent.kept(cells))
        if isinstance(message, GetDifferentialRequest):
            writer.texts(removed or ())
        content = writer.content(self._sent)
        self._sent = content if len(content) <= _REUSED_BYTES else None
        return content

    def _write_cells(self, writer: CdrWriter, cells: Sequence[Cell]) -> None:
        """Append cells with their points, a sequence of ``autoware_map_msgs/PointCloudMapCellWithID``."""
        writer.uint32(len(cells))
        for cell in cells:
            columns = cell.columns
            kind = tuple((name, one.dtype, one.shape[1:]) for name, one in columns.items())
            layout = self._layouts.get(kind)
            if layout is None:
                if len(self._layouts) >= _LAYOUTS:
                    self._layouts.clear()
                layout = self._layouts[kind] = cloud_layout(columns)
            writer.text(cell.id)
            write_cloud(writer, columns, cell.origin, layout)
            writer.float32(*cell.box)


def _nothing() -> None:
    """Nothing has to be remembered of an answer that says all."""

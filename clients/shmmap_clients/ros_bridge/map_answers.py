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

What is more than the daemon answers at once is asked for in slices.

Autoware's request names cells, but not their versions: a file that has changed would never reach a client
that has its cell already.  So the bridge remembers what each client was sent (`Requesters`), and sends a
changed cell again under its id.
"""

from __future__ import annotations

import math
import time
from collections import OrderedDict
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap import AutowareSquare, Cell, CellInfo, CellSet, Client
from shmmap_clients.ros_bridge.cdr import MAX_BYTES, CdrWriter, Content
from shmmap_clients.ros_bridge.messages import GetDifferentialRequest, GetPartialRequest
from shmmap_clients.ros_bridge.point_cloud import CloudLayout, cloud_layout, write_cloud
from shmmap_clients.ros_bridge.worker import StillLoading, TooLarge, no_followup

__all__ = ["MAX_REQUESTERS", "Catalogue", "MapAnswers", "RecentCells", "Requesters", "sensible", "touches"]

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


_MAX_RECENT_BYTES: Final = 64 << 20
_KEPT_S: Final = 2.0
_PAUSE_S: Final = 0.2
_TURN_S: Final = 1.0
"""How long others wait for cells that one client's request has loaded."""
_SLICE_CELLS: Final = 10_000
_SLICE_BYTES: Final = 1 << 20
"""Cells and bytes of one request to the daemon, which accepts at most 20 000 cells and 4 MiB."""
_MAX_CELLS: Final = 100_000
"""Of one answer, repetitions included."""
_NAMED: Final = 3
_REUSED_BYTES: Final = 16 << 20
_LAYOUTS: Final = 64
Log = Callable[[str], None]


def sensible(area: Any) -> AutowareSquare | None:
    """Return the square that an ``AreaInfo`` means; None where only `touches` knows."""
    x, y, radius = area.center_x, area.center_y, area.radius
    if not all(map(math.isfinite, (x, y, radius))) or radius < 0:
        return None
    return AutowareSquare(x, y, radius)


def touches(area: Any, boxes: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which of ``boxes``, (N, 4) min_x min_y max_x max_y in metres, any ``AreaInfo`` touches, (N,).

    Autoware's test (``cylinder_and_box_overlap_exists``) is a square of half-side ``radius`` with closed
    borders, on float32 numbers in double arithmetic.  `shmmap.AutowareSquare` is that square for every area
    that makes sense.  Autoware also answers the others: a negative radius shrinks each box, infinity takes
    everything, and what is no number touches nothing.
    """
    place = np.array([area.center_x, area.center_y], np.float64)
    radius = float(area.radius)
    low, high = (boxes[:, part].astype(np.float32).astype(np.float64) for part in ([0, 1], [2, 3]))
    with np.errstate(invalid="ignore"):
        inside: NDArray[np.bool_] = np.all((low - radius <= place) & (place <= high + radius), axis=1)
        # where x and radius are infinite and y is no number a corner is within the radius
        for corner in (low, high, np.stack([low[:, 0], high[:, 1]], 1), np.stack([high[:, 0], low[:, 1]], 1)):
            inside |= np.hypot(*(place - corner).T) <= radius
    return inside


class RecentCells:
    """Cells of recent answers, at most 64 MiB.

    Mapping a cell takes as long as sending it, and other clients often ask for the same one.  After two
    seconds without a request all are dropped, so that the daemon may evict them.
    """

    def __init__(self) -> None:
        self._cells: OrderedDict[tuple[str, int], Cell] = OrderedDict()  # the newest last
        self._bytes = 0
        self._until_s = 0.0

    def __len__(self) -> int:
        return len(self._cells)

    def kept(self, cells: Iterable[Cell]) -> list[Cell]:
        """Keep these cells; returns them, those that were kept before with the arrays that they have made."""
        found = []
        for cell in cells:
            key = cell.id, cell.version
            one = self._cells.get(key)
            if one is None:
                one = self._cells[key] = cell
                self._bytes += cell.nbytes
            else:
                self._cells.move_to_end(key)
            found.append(one)
        while self._bytes > _MAX_RECENT_BYTES:
            self._bytes -= self._cells.popitem(last=False)[1].nbytes
        self._until_s = time.monotonic() + _KEPT_S
        return found

    def release_idle(self) -> bool:
        """Release all cells if there was no request for two seconds; returns whether that is so."""
        if not self._cells or time.monotonic() < self._until_s:
            return False
        self._cells.clear()
        self._bytes = 0
        return True


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
        Takes a line about what is left out.
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
        self._until_s = 0.0
        self._sent: Content | None = None  # the reply before: its memory is used again

    def answer(
        self, message: Any, requester: str, begun_s: float | None = None
    ) -> tuple[Content, Callable[[], None]]:
        """Return a reply, and what to call when it was sent.

        It has to be sent before the next one is asked for.  ``begun_s`` is when this request was tried first.

        Raises
        ------
        StillLoading
            Not all is there yet: it is to be tried again, others first.
        TooLarge
            No reply can hold it.
        ShmmapError
            The daemon does not answer, or refuses; nothing has changed then.
        """
        self._until_s = (time.monotonic() if begun_s is None else begun_s) + self._wait_s
        if isinstance(message, GetDifferentialRequest):
            return self._differential(message, requester)
        if isinstance(message, GetPartialRequest):
            area = sensible(message.area)
            if area is not None and self._is_small(message.area):
                cells: Sequence[Cell] = self._all(
                    lambda wait: self._client.area(area, wait=wait, strict=None)
                )
            else:
                cells = self._selected(self._touched(message.area))
        else:
            cells = self._selected(self._known(message.cell_ids))
        return self._reply(message, cells), no_followup

    def empty(self, message: Any) -> Content:
        """Return the reply that has nothing, for a request that the daemon refuses."""
        return self._reply(message, ())

    def _differential(
        self, message: GetDifferentialRequest, requester: str
    ) -> tuple[Content, Callable[[], None]]:
        held = self._requesters.held(requester, message.cached_ids, self._catalogue.versions)
        area = sensible(message.area)
        if area is not None and _is_one_slice(message.cached_ids) and self._is_small(message.area):
            found = self._all(lambda wait: self._client.differential(area, held, wait=wait, strict=None))
            cells: Sequence[Cell] = found
            removed: Collection[str] = found.removed
        else:
            wanted = self._touched(message.area)
            versions = dict(held)
            current = self._catalogue.versions
            cells = self._selected([one for one in wanted if versions.get(one) != current[one]])
            inside = set(wanted)
            removed = [one for one, _version in held if one not in inside]
        sent = {cell.id: cell.version for cell in cells}

        def done() -> None:
            self._requesters.answered(requester, held, removed, sent)

        return self._reply(message, cells, removed), done

    def _is_small(self, area: Any) -> bool:
        """Whether the daemon answers with the cells of an area at once."""
        few = len(self._catalogue.cells) <= _SLICE_CELLS
        return few or int(touches(area, self._catalogue.boxes()).sum()) <= _SLICE_CELLS

    def _touched(self, area: Any) -> list[str]:
        self._catalogue.refresh(self._client)
        inside = touches(area, self._catalogue.boxes())
        return [one for one, take in zip(self._catalogue.cells, inside, strict=True) if take]

    def _known(self, ids: Sequence[str]) -> Sequence[str]:
        """Return the ids; of very many only those of the map: answers leave out the others anyway."""
        if _is_one_slice(ids):
            return ids
        self._catalogue.refresh(self._client)
        known = self._catalogue.cells.keys() | {one.rpartition("/")[2] for one in self._catalogue.cells}
        return [one for one in ids if one in known]

    def _selected(self, ids: Sequence[str]) -> Sequence[Cell]:
        if len(ids) > _MAX_CELLS:
            raise TooLarge(f"{len(ids):,} cells in one request", hint=f"ask for at most {_MAX_CELLS:,}")
        found: list[Cell] = []
        for some in _slices(ids):
            found += self._all(lambda wait, some=some: self._client.selected(some, wait=wait, strict=None))  # type: ignore[misc]
        return found

    def _all(self, ask: Callable[[float], CellSet]) -> CellSet:
        """Ask the daemon; what is missing although it has had time is logged, and left out."""
        left_s = max(0.0, self._until_s - time.monotonic())
        cells = ask(min(left_s, _TURN_S))
        if left_s > _TURN_S:
            if not cells.covered:
                time.sleep(_PAUSE_S)
            if cells.pending or not cells.covered:
                raise StillLoading
        missing = [str(error) for error in cells.failed]
        missing += [f"{one.id}: not loaded after {self._wait_s:g} s" for one in cells.pending]
        if missing:
            more = f"; and {len(missing) - _NAMED} more" if len(missing) > _NAMED else ""
            self._log(f"left out of an answer: {'; '.join(missing[:_NAMED])}{more}")
        return cells

    def release_idle(self) -> None:
        """Release cells that no client has asked for lately."""
        if self._recent.release_idle():
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
        try:
            content = writer.content(self._sent)
        except ValueError as error:
            raise TooLarge(f"an answer of {error}", hint="ask for fewer cells at once") from error
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
            if writer.size > MAX_BYTES:  # repetitions of a large cell: thousands more would take long
                raise TooLarge(
                    f"an answer of more than {MAX_BYTES} bytes", hint="ask for fewer cells at once"
                )


def _is_one_slice(ids: Sequence[str]) -> bool:
    return len(ids) <= _SLICE_CELLS and sum(map(len, ids)) <= _SLICE_BYTES // 4  # bytes of a character


def _slices(ids: Sequence[str]) -> Iterator[Sequence[str]]:
    """Ids in parts, in their order, each of which is one request."""
    begin = nbytes = 0
    for at, one in enumerate(ids):
        nbytes += 4 * len(one)
        if at - begin >= _SLICE_CELLS or nbytes > _SLICE_BYTES:
            yield ids[begin:at]
            begin, nbytes = at, 4 * len(one)
    if begin < len(ids):
        yield ids[begin:]

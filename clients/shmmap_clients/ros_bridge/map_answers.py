# SPDX-License-Identifier: Apache-2.0
"""Answers to Autoware's three requests for cells, as from its map loader.

- Partial and differential answers are in the order of ids.  Selected ones are in the order of the request,
  with repetitions.  Unknown ids are left out.
- ``ids_to_remove`` lists the ids of the request that are no longer needed, unknown ones included, in the
  order given.
- The header has the map's frame and time zero; the header of each cloud is empty.

Three differences from Autoware: a cell that cannot be loaded is left out, while Autoware sends it empty, so
that the client takes it for free space; an id that a request repeats is not removed for that reason; and a
cell whose file has changed since it was sent is sent again.

Requests above the daemon's limits are split into slices.

Autoware's request names cells, but not their versions, so that a changed file would never reach a client that
already has the cell.  So the bridge remembers the versions sent to each client (`Requesters`), and sends a
changed cell again under its id.
"""

from __future__ import annotations

import math
import time
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap import AutowareSquare, Cell, CellInfo, CellSet, Client
from shmmap_clients.ros_bridge.cdr import MAX_BYTES, CdrWriter, Content
from shmmap_clients.ros_bridge.messages import DIFFERENTIAL, PARTIAL
from shmmap_clients.ros_bridge.point_cloud import write_cloud
from shmmap_clients.ros_bridge.worker import StillLoading, TooLarge, no_followup

__all__ = ["MAX_REQUESTERS", "Catalogue", "MapAnswers", "RecentCells", "Requesters", "sensible", "touches"]

MAX_REQUESTERS: Final = 256
"""Largest number of remembered clients; the one with the oldest request is forgotten first."""


class Catalogue:
    """Cells by id, of one map version.

    Attributes
    ----------
    cells : dict
        `shmmap.CellInfo` by id, in the order of ids.
    versions : dict
        Version of each cell's points by id.
    map_version : int or None
        Version of the map; None before the first `refresh`.
    """

    def __init__(self) -> None:
        self.cells: dict[str, CellInfo] = {}
        self.versions: dict[str, int] = {}
        self.map_version: int | None = None

    def refresh(self, client: Client) -> None:
        """Fetch the changes of the map.

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
        """Return the list of cells as ``autoware_map_msgs/PointCloudMapMetaData``."""
        writer = CdrWriter()
        writer.numbers("iI", stamp_ns // 10**9, stamp_ns % 10**9)
        writer.text(frame_id)
        writer.numbers("I", len(self.cells))
        for cell in self.cells.values():
            writer.text(cell.id)
            writer.numbers("ffff", *cell.box)
        return writer.content()


class Requesters:
    """Versions that were sent, by client and cell.

    Parameters
    ----------
    most
        Largest number of remembered clients.
    """

    def __init__(self, most: int = MAX_REQUESTERS) -> None:
        self._most = most
        self._versions: OrderedDict[str, dict[str, int]] = OrderedDict()

    def __len__(self) -> int:
        return len(self._versions)

    def held(
        self, requester: str, ids: Iterable[str], current: Mapping[str, int]
    ) -> list[tuple[str, int | None]]:
        """Return the cells that a client has: ids with versions.

        Parameters
        ----------
        requester
            The client.
        ids
            Ids that the client reports to have.
        current
            Present versions of cells; a cell not sent by this bridge counts as current, as in Autoware.

        Returns
        -------
        One pair for each id, unknown ones included, in the order given, without repetitions.
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
        """Record the cells that a client has after an answer.

        Parameters
        ----------
        held, removed, sent
            Cells it had before, ids it was asked to drop, and versions of the cells sent to it.
        """
        gone = set(removed)
        versions = {one: version for one, version in held if version is not None and one not in gone}
        versions.update(sent)
        self._versions[requester] = versions
        self._versions.move_to_end(requester)
        while len(self._versions) > self._most:
            self._versions.popitem(last=False)

    def keep_only(self, alive: Collection[str]) -> None:
        """Forget all clients except these."""
        for requester in [one for one in self._versions if one not in alive]:
            del self._versions[requester]


_MAX_RECENT_BYTES: Final = 64 << 20
_KEPT_S: Final = 2.0
_PAUSE_S: Final = 0.2
_TURN_S: Final = 1.0
"""Longest time that one client's request may wait for loading while other clients wait, seconds."""
_SLICE_CELLS: Final = 10_000
_SLICE_BYTES: Final = 1 << 20
"""Cells and bytes of one request to the daemon, which accepts at most 20 000 cells and 4 MiB."""
_MAX_CELLS: Final = 100_000
"""Largest number of cells in one answer, repetitions included."""
_NAMED: Final = 3
_REUSED_BYTES: Final = 16 << 20
Log = Callable[[str], None]


def sensible(area: Any) -> AutowareSquare | None:
    """Return the square of an ``AreaInfo``; None for unusual values, which only `touches` handles."""
    x, y, radius = area.center_x, area.center_y, area.radius
    if not all(map(math.isfinite, (x, y, radius))) or radius < 0:
        return None
    return AutowareSquare(x, y, radius)


def touches(area: Any, boxes: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return a mask (N,) of the ``boxes``, (N, 4) min_x min_y max_x max_y, metres, that an area touches.

    Autoware's test (``cylinder_and_box_overlap_exists``) is a square of half-side ``radius`` with closed
    borders, on float32 numbers in double arithmetic.  `shmmap.AutowareSquare` is that square for every valid
    area.  Autoware also answers invalid ones: a negative radius shrinks each box, infinity selects all boxes,
    and NaN none.
    """
    place = np.array([area.center_x, area.center_y], np.float64)
    radius = float(area.radius)
    low, high = (boxes[:, part].astype(np.float32).astype(np.float64) for part in ([0, 1], [2, 3]))
    with np.errstate(invalid="ignore"):
        inside: NDArray[np.bool_] = np.all((low - radius <= place) & (place <= high + radius), axis=1)
        # with infinite x and radius, and NaN as y, a corner is within the radius
        for corner in (low, high, np.stack([low[:, 0], high[:, 1]], 1), np.stack([high[:, 0], low[:, 1]], 1)):
            inside |= np.hypot(*(place - corner).T) <= radius
    return inside


class RecentCells:
    """Cache of the cells of recent answers, at most 64 MiB.

    Mapping a cell takes as long as sending it, and other clients often request the same one.  After two
    seconds without a request, all cells are dropped, so that the daemon may evict them.
    """

    def __init__(self) -> None:
        self._cells: OrderedDict[tuple[str, int], Cell] = OrderedDict()  # newest last
        self._bytes = 0
        self._until_s = 0.0

    def __len__(self) -> int:
        return len(self._cells)

    def kept(self, cells: Iterable[Cell]) -> list[Cell]:
        """Keep these cells and return them; cells kept before are returned as the same objects."""
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
        """Release all cells after two seconds without a request; return whether this was the case."""
        if not self._cells or time.monotonic() < self._until_s:
            return False
        self._cells.clear()
        self._bytes = 0
        return True


class MapAnswers:
    """Builder of answers from the daemon's cells.

    Parameters
    ----------
    client
        Client of the daemon.
    catalogue
        List of the map's cells.
    requesters
        Versions that each client has.
    wait_s
        Time for the daemon to load cells, seconds; cells missing after it are left out.
    log
        Called with a line about omitted cells.
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
        self._until_s = 0.0
        self._sent: Content | None = None  # the last reply, whose memory is reused

    def answer(self, message: Any, requester: str, begun_s: float) -> tuple[Content, Callable[[], None]]:
        """Return a reply, and a function to call once it has been sent.

        Send it before the next call.  ``begun_s`` is the time of the first attempt at this request.

        Raises
        ------
        StillLoading
            Some cells are not loaded yet: try again after the requests of other clients.
        TooLarge
            The cells do not fit into one reply.
        ShmmapError
            The daemon does not answer, or refuses; the state is then unchanged.
        """
        self._until_s = begun_s + self._wait_s
        if isinstance(message, DIFFERENTIAL.request):
            return self._differential(message, requester)
        if isinstance(message, PARTIAL.request):
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
        """Return the empty reply, for a request that the daemon refuses."""
        return self._reply(message, ())

    def _differential(self, message: Any, requester: str) -> tuple[Content, Callable[[], None]]:
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
        """Return whether the daemon answers a request for an area without slices."""
        few = len(self._catalogue.cells) <= _SLICE_CELLS
        return few or int(touches(area, self._catalogue.boxes()).sum()) <= _SLICE_CELLS

    def _touched(self, area: Any) -> list[str]:
        self._catalogue.refresh(self._client)
        inside = touches(area, self._catalogue.boxes())
        return [one for one, take in zip(self._catalogue.cells, inside, strict=True) if take]

    def _known(self, ids: Sequence[str]) -> Sequence[str]:
        """Return the ids; of a long list only those in the map, since answers omit the others anyway."""
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
        """Ask the daemon for cells; log and omit those that are still missing after the timeout."""
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
        """Release cells that no client has requested lately."""
        if self._recent.release_idle():
            self._client.release()

    def _reply(self, message: Any, cells: Iterable[Cell], removed: Collection[str] | None = None) -> Content:
        writer = CdrWriter()
        writer.numbers("QqiI", message.client, message.number, 0, 0)
        writer.text(self._client.welcome.frame_id)
        self._write_cells(writer, self._recent.kept(cells))
        if isinstance(message, DIFFERENTIAL.request):
            writer.texts(removed or ())
        try:
            content = writer.content(self._sent)
        except ValueError as error:
            raise TooLarge(f"an answer of {error}", hint="ask for fewer cells at once") from error
        self._sent = content if len(content) <= _REUSED_BYTES else None
        return content

    def _write_cells(self, writer: CdrWriter, cells: Sequence[Cell]) -> None:
        """Append cells with their points, a sequence of ``autoware_map_msgs/PointCloudMapCellWithID``."""
        writer.numbers("I", len(cells))
        for cell in cells:
            writer.text(cell.id)
            write_cloud(writer, cell.columns, cell.origin)
            writer.numbers("ffff", *cell.box)
            if writer.size > MAX_BYTES:  # stop early: thousands of repetitions take long
                raise TooLarge(
                    f"an answer of more than {MAX_BYTES} bytes", hint="ask for fewer cells at once"
                )


def _is_one_slice(ids: Sequence[str]) -> bool:
    return len(ids) <= _SLICE_CELLS and sum(map(len, ids)) <= _SLICE_BYTES // 4  # up to 4 bytes a character


def _slices(ids: Sequence[str]) -> Iterator[Sequence[str]]:
    """Split ids, in order, into parts of one request each."""
    begin = nbytes = 0
    for at, one in enumerate(ids):
        nbytes += 4 * len(one)
        if at - begin >= _SLICE_CELLS or nbytes > _SLICE_BYTES:
            yield ids[begin:at]
            begin, nbytes = at, 4 * len(one)
    if begin < len(ids):
        yield ids[begin:]

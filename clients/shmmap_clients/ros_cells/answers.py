# SPDX-License-Identifier: Apache-2.0
"""Answers to Autoware's three requests for cells, as from its map loader.

- Partial and differential answers are in the order of ids.  Selected ones are in the order of the request,
  with repetitions.  Unknown names are left out.
- ``ids_to_remove`` lists the names of the request that are no longer needed, in the order given: of cells
  outside of the area, unknown ones, and old names of cells that come under a new one.

Three differences from Autoware: a cell that cannot be loaded is left out, while Autoware sends it empty, so
that the client takes it for free space; a name that a request repeats is not removed for that reason; and a
changed cell comes again.

No thread waits for cells: a request starts the loads, and raises `StillLoading` until they are there.
Requests above the daemon's limits are split into slices.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap import AutowareSquare, Cell, CellSet, Client, DaemonUnreachable, StaleHandle
from shmmap.errors import (
    Busy,
    CellError,
    LiveInterrupted,
    NoSession,
    NoSpace,
    Offline,
    OverBudget,
    ProtocolMismatch,
)
from shmmap_clients.ros_cells.catalogue import Catalogue, RecentCells, cell_name, split_name
from shmmap_clients.ros_cells.point_cloud import MAX_BYTES, message_bytes

LATER: Final = (DaemonUnreachable, NoSession, Busy, LiveInterrupted, StaleHandle, ProtocolMismatch)
"""Errors after which a request waits and is tried again; after others it gets an empty answer."""
_SLICE_CELLS: Final = 10_000
_SLICE_BYTES: Final = 1 << 20
"""Cells and bytes of one request to the daemon, which accepts at most 20 000 cells and 4 MiB."""
_MAX_CELLS: Final = 100_000
"""Largest number of cells in one answer, repetitions included."""
_HEAD_BYTES: Final = 1 << 16
_NAMED: Final = 3


class StillLoading(Exception):
    """Cells are not there yet: ask again after an event of the daemon.  The text says for what it waits."""


@dataclass(slots=True)
class Answer:
    """Cells of a reply.

    Attributes
    ----------
    cells, names
        The cells, and their names in the message.
    removed
        Names of the request that its sender should drop, for ``ids_to_remove``.
    left_out
        A line about each cell that is missing.
    too_large
        Number of cells that did not fit into the message.
    """

    cells: list[Cell] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    removed: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    too_large: int = 0

    @property
    def problem(self) -> str:
        """What is wrong with the answer, as a line for the log; empty if nothing is."""
        lines = []
        if self.too_large:
            lines.append(
                f"{self.too_large:,} cells do not fit into one answer, and {len(self.cells):,} are sent:"
                " ask for fewer at once"
            )
        if self.left_out:
            more = f"; and {len(self.left_out) - _NAMED} more" if len(self.left_out) > _NAMED else ""
            lines.append(f"left out of an answer: {'; '.join(self.left_out[:_NAMED])}{more}")
        return "; ".join(lines)


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


class CellAnswers:
    """Builder of answers from the daemon's cells.  Several threads may use it, each with its own client.

    An ``area`` has ``center_x``, ``center_y`` and ``radius``, metres, map frame.  With ``last``, an answer
    has the cells that are there; without, `StillLoading` is raised while cells are missing that may come.

    Parameters
    ----------
    catalogue
        List of the map's cells.
    recent
        Cells of recent answers.
    plain_ids
        Names are ids alone, as from Autoware's map loader.  A cell that changes is then never sent again to
        those who have it.
    max_bytes
        Largest message.
    """

    def __init__(
        self,
        catalogue: Catalogue,
        recent: RecentCells,
        *,
        plain_ids: bool = False,
        max_bytes: int = MAX_BYTES,
    ) -> None:
        self._catalogue = catalogue
        self._recent = recent
        self._plain_ids = plain_ids
        self._max_bytes = max_bytes - _HEAD_BYTES

    def partial(self, client: Client, area: Any, last: bool) -> Answer:
        """Return the cells that touch an area.

        Raises
        ------
        StillLoading
            Cells are not loaded yet; with ``last``, only if none is, for want of memory that others hold.
        ShmmapError
            The daemon does not answer (`LATER`), or refuses.
        """
        square = self._small_square(client, area)
        if square is not None:
            return self._answer([client.area(square, wait=0, strict=None)], last, area)
        return self._answer(self._selected(client, self._touched(client, area)), last, area)

    def differential(self, client: Client, area: Any, cached_ids: Iterable[str], last: bool) -> Answer:
        """Return the cells that touch an area, less those that the sender has at their present version.

        A plain id in ``cached_ids`` is outdated: it is removed, and its cell sent under its name.

        Raises
        ------
        StillLoading, ShmmapError
            As from `partial`.
        """
        cached = {text: self._held(text) for text in cached_ids}
        square = self._small_square(client, area)
        if square is not None and _is_one_slice(cached):
            found = client.differential(square, cached.values(), wait=0, strict=None)
            gone = set(found.removed)
            answer = self._answer([found], last, area)
        else:
            wanted = self._touched(client, area)
            held, now = set(cached.values()), self._catalogue.versions
            new = [one for one in wanted if held.isdisjoint(((one, now[one]), (one, None)))]
            gone = {one for one, _ in held}.difference(wanted)
            answer = self._answer(self._selected(client, new), last, area)
        for cell in answer.cells:  # by whichever id it was cached
            gone.update((cell.id, cell.name, cell.id.rpartition("/")[2]))
        gone_names = self._old_names(client, cached)
        answer.removed = [one for one, (cell_id, _) in cached.items() if cell_id in gone or one in gone_names]
        return answer

    def selected(self, client: Client, ids: Sequence[str], last: bool) -> Answer:
        """Return the cells of these names, whatever their versions, or ids.

        Raises
        ------
        StillLoading, ShmmapError
            As from `partial`.
        """
        wanted: Sequence[str] = [self._split(one)[0] for one in ids]
        if not _is_one_slice(wanted):  # answers omit the unknown ones anyway
            self._catalogue.refresh(client)
            cells = self._catalogue.cells
            known = cells.keys() | {one.rpartition("/")[2] for one in cells}
            wanted = [one for one in wanted if one in known]
        answer = self._answer(self._selected(client, wanted[:_MAX_CELLS]), last)
        answer.too_large += max(len(wanted) - _MAX_CELLS, 0)
        return answer

    # --- names --------------------------------------------------------------------------------------

    def name(self, cell_id: str, version: int) -> str:
        """Return the name of a cell in messages."""
        return cell_id if self._plain_ids else cell_name(cell_id, version)

    def _split(self, text: str) -> tuple[str, int | None]:
        return (text, None) if self._plain_ids else split_name(text)

    def _held(self, text: str) -> tuple[str, int | None]:
        """Return id and version of a cached cell; 0, which no cell has, where the name lacks it."""
        cell_id, version = self._split(text)
        return cell_id, 0 if version is None and not self._plain_ids else version

    def _old_names(self, client: Client, cached: dict[str, tuple[str, int | None]]) -> set[str]:
        """Return the old names of cells whose present name the sender has as well."""
        if len({one for one, _ in cached.values()}) == len(cached):
            return set()
        self._catalogue.refresh(client)
        now, held = self._catalogue.versions, set(cached.values())
        current = {one for one in now.items() if one in held}
        ids = {one for one, _ in current}
        return {text for text, one in cached.items() if one[0] in ids and one not in current}

    # --- cells --------------------------------------------------------------------------------------

    def _small_square(self, client: Client, area: Any) -> AutowareSquare | None:
        """Return the square of a valid area that the daemon answers without slices; else None."""
        if self._catalogue.map_version is None:
            self._catalogue.refresh(client)
        few = len(self._catalogue.cells) <= _SLICE_CELLS
        if few or int(touches(area, self._catalogue.boxes()).sum()) <= _SLICE_CELLS:
            return sensible(area)
        return None

    def _touched(self, client: Client, area: Any) -> list[str]:
        """Return the ids of an area's cells, the nearest to its centre first."""
        self._catalogue.refresh(client)
        boxes, ids = self._catalogue.boxes(), list(self._catalogue.cells)
        inside = np.flatnonzero(touches(area, boxes))
        return [ids[one] for one in inside[_nearest(area, boxes[inside])]]

    def _selected(self, client: Client, ids: Sequence[str]) -> Iterator[CellSet]:
        for some in _slices(ids):
            yield client.selected(some, wait=0, strict=None)

    def _answer(self, found: Iterable[CellSet], last: bool, area: Any = None) -> Answer:
        """Return the cells that are there; those of an ``area`` in the order of ids."""
        answer, nbytes, away = Answer(), 0, dict[str, None]()
        for some in found:
            answer.cells += self._recent.kept(some)
            if not last and (some.pending or not some.covered):
                raise StillLoading
            answer.left_out += [str(one) for one in some.failed]
            answer.left_out += [f"{one.id}: not loaded in time" for one in some.pending]
            away.update((one.message, None) for one in some.failed if _is_away(one, last))
            nbytes += sum(self._bytes(cell) for cell in some)
            if nbytes > self._max_bytes:
                break
        if away and not answer.cells:  # an empty answer would be taken for an empty map, or no change
            raise StillLoading(f"none of its cells can be had: {next(iter(away))}")
        if nbytes > self._max_bytes:
            self._fit(answer, area)
        if area is not None:
            answer.cells.sort(key=lambda cell: cell.id)
        answer.names = [self.name(cell.id, cell.version) for cell in answer.cells]
        return answer

    def _bytes(self, cell: Cell) -> int:
        return message_bytes(cell.columns, self.name(cell.id, cell.version))

    def _fit(self, answer: Answer, area: Any) -> None:
        """Leave as many cells in an answer as fit: the nearest of an area, or else the first."""
        cells = answer.cells
        boxes = np.array([cell.box for cell in cells], np.float64).reshape(-1, 4)
        order = range(len(cells)) if area is None else _nearest(area, boxes).tolist()
        left, fit = self._max_bytes, []
        for one in order:
            nbytes = self._bytes(cells[one])
            if nbytes <= left:
                left -= nbytes
                fit.append(one)
        answer.cells = [cells[one] for one in fit]
        answer.too_large = len(cells) - len(fit)


def _is_away(error: CellError, last: bool) -> bool:
    """Return whether a cell is missing for want of memory that others hold, or of a network until `last`."""
    if isinstance(error, OverBudget):
        return bool(error.holders)  # else it never fits
    return isinstance(error, NoSpace) or (isinstance(error, Offline) and not last)


def _nearest(area: Any, boxes: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the order of boxes, (N, 4), by their distance from an area's centre."""
    place = np.array([area.center_x, area.center_y], np.float64)
    with np.errstate(invalid="ignore"):
        outside = np.maximum(np.maximum(boxes[:, :2] - place, place - boxes[:, 2:]), 0.0)
        return np.argsort(np.hypot(*outside.T), kind="stable")


def _is_one_slice(ids: Iterable[str]) -> bool:
    sizes = [len(one) for one in ids]
    return len(sizes) <= _SLICE_CELLS and sum(sizes) <= _SLICE_BYTES // 4  # up to 4 bytes a character


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

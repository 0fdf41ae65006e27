# SPDX-License-Identifier: Apache-2.0
"""Queries of any client about the map: connection data, the list of cells, one cell, statistics."""

from __future__ import annotations

import bisect
import itertools
import math
import os
from collections import deque
from collections.abc import Generator, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.cache.holders import Share, Usage
from shmmap.daemon.cache.map_switch import MapSwitch
from shmmap.daemon.config import DaemonConfig
from shmmap.daemon.events.log import EventLog
from shmmap.daemon.loading.loads import Loads
from shmmap.daemon.map.catalogue_view import Pages
from shmmap.daemon.records import Resident
from shmmap.daemon.requests.operators.operator_pins import OperatorPins
from shmmap.daemon.telemetry.sampler import client_row
from shmmap.daemon.transport.connection import Connection
from shmmap.daemon.transport.sessions import Session, Sessions
from shmmap.errors import BadRequest, Offline, ShmmapError, UnknownCell
from shmmap.geometry import Area
from shmmap.layers.spec import kinds
from shmmap.origin.spatial_index import touches
from shmmap.protocol import messages
from shmmap.protocol.codec import encode
from shmmap.protocol.events import Recent
from shmmap.protocol.rows import CellState
from shmmap.version import build_version

PAGE_ROWS: Final = 500
"""Rows of a metadata page, at most: a full one takes the serving loop about a millisecond."""
SEGMENTS_PER_PAGE: Final = 64
"""Segments in a page of the list of those in memory: half a millisecond of the serving loop."""
LOOKED_AT: Final = 20_000
"""Cells tested for one page of an area's metadata; retired segments examined for one cell."""
METADATA_WAIT_S: Final = 0.25
"""How long a metadata request waits for a page of the map; clients repeat it until the page has arrived."""
MAX_WAITING: Final = 1024
ROW_BITS: Final = 32


class _Waiting(NamedTuple):
    """A metadata request that waits for a page of the map."""

    connection: Connection
    message: messages.Metadata
    deadline_s: float


class _Changes(NamedTuple):
    """Difference between two states of the map: catalogue indices, ascending, and ids of removed cells."""

    between: tuple[int, int]
    cells: NDArray[np.intp]
    removed: tuple[str, ...]


@dataclass(eq=False, slots=True)
class MapQueries:
    """Answers queries from the catalogue and the cache.

    Parameters
    ----------
    pins
        The cells that operators pinned.
    events_path
        Address at which events are published; empty if they are not.
    """

    config: DaemonConfig
    cache: CellCache
    sessions: Sessions
    pins: OperatorPins
    map_switch: MapSwitch
    loads: Loads
    event_log: EventLog
    events_path: str = ""
    _changes: _Changes | None = None
    _waiting: deque[_Waiting] = field(default_factory=deque)  # the first to time out first
    _kinds: tuple[str, ...] = field(init=False, default_factory=lambda: tuple(k.describe() for k in kinds()))

    def welcome(self, session: Session, message: messages.Hello) -> messages.Welcome:
        """Return the answer to a new client's hello: everything it needs to connect."""
        cache, catalogue, (major, minor) = self.cache, self.cache.catalogue, messages.PROTOCOL_VERSION
        ledger = cache.ledger
        return messages.Welcome(
            message.request, major, minor, daemon=build_version(), instance=self.config.instance,
            epoch=self.cache.epoch, session=session.slot, map_version=catalogue.map_version,
            map_path=self.config.map_path, frame_id=catalogue.frame_id, shm_dir=self.config.shm_dir,
            id_prefix=cache.id_prefix, segment_prefix=cache.segment_prefix, cells=len(catalogue),
            bounds=catalogue.bounds, layers=self._kinds,
            budget_bytes=ledger.budget_bytes, pid=os.getpid(), events=self.events_path,
            origin=catalogue.frame.origin, crs=catalogue.frame.crs, unit_m=catalogue.frame.unit_m,
        )  # fmt: skip

    def answer(self, message: messages.Request) -> messages.Reply:
        """Return the answer to a query."""
        if isinstance(message, Recent):
            return self.event_log.page(message)
        if isinstance(message, messages.ListCells):
            return self._cells_page(message)
        if isinstance(message, messages.Show):
            return self._show(message)
        raise BadRequest(f"a {type(message).__name__} cannot be answered here")

    # --- the list of cells ------------------------------------------------------------------------

    def metadata(self, session: Session, message: messages.Metadata, now_s: float) -> None:
        """Answer with a page of the list of cells; wait briefly if a page of the map is missing.

        Raises
        ------
        Offline
            The missing page of the map cannot be fetched at present.
        """
        self._answer_or_wait(_Waiting(session.connection, message, now_s + METADATA_WAIT_S), now_s)

    def _answer_or_wait(self, one: _Waiting, now_s: float) -> None:
        page = self.page(one.message)
        if page is None and now_s < one.deadline_s and len(self._waiting) < MAX_WAITING:
            self._waiting.append(one)
        else:
            one.connection.reply(encode(page or self.page(one.message, empty=True)))

    def pages_finished(self, now_s: float) -> None:
        """Answer requests that waited for pages which have arrived, or cannot be fetched."""
        for _ in range(len(self._waiting)):
            self._answer_first(now_s)

    @property
    def next_deadline_s(self) -> float:
        """When the first waiting request times out; infinity if none waits."""
        return self._waiting[0].deadline_s if self._waiting else math.inf

    def answer_overdue(self, now_s: float) -> None:
        """Answer requests that have timed out: clients repeat them."""
        while self._waiting and now_s >= self._waiting[0].deadline_s:
            self._answer_first(now_s)

    def _answer_first(self, now_s: float) -> None:
        """Answer the first of the waiting requests, or let it wait behind the others."""
        one = self._waiting.popleft()
        try:
            self._answer_or_wait(one, now_s)
        except ShmmapError as error:
            one.connection.refuse(one.message.request, error)

    def page(self, message: messages.Metadata, *, empty: bool = False) -> messages.MetadataPage | None:
        """Return a metadata page; if a page of the map is missing, None, or a page without rows if ``empty``.

        Raises
        ------
        Offline
            The missing page of the map cannot be fetched at present.
        """
        catalogue = self.cache.catalogue
        removed: tuple[str, ...] = ()
        start, limit = max(0, message.start), max(1, min(message.limit, PAGE_ROWS))
        area = messages.area_from_message(message.area) if message.area is not None else None
        change = self._changes_since(message.since) if message.since is not None else None
        known = message.since is None or change is not None
        found: tuple[Sequence[int], int | None] | None
        if change is not None:
            found = self._changed_rows(change.cells, area, start, limit)
            removed = change.removed if start == 0 else ()
        elif catalogue.pages is None:
            found = self._rows(area, start, limit)
        else:
            found = self._rows_of_pages(catalogue.pages, area, start, limit)
        if found is None and not empty:
            return None
        found = found or ((), start)
        rows, next_start = tuple(map(self._row, found[0])), found[1]
        return messages.MetadataPage(
            message.request, self.cache.epoch, catalogue.map_version, rows, next_start, known, removed
        )

    def _changed_rows(
        self, touched: NDArray[np.intp], area: Area | None, start: int, limit: int
    ) -> tuple[Sequence[int], int | None] | None:
        """Return changed cells from position ``start``, and the next position; None if pages are missing."""
        catalogue = self.cache.catalogue
        if (pages := catalogue.pages) is not None:
            page_of = pages.of_cell
            if not self._have_come(pages, sorted({page_of(index) for index in touched.tolist()})):
                return None
        if area is not None:
            touched = touched[touches(area, catalogue.boxes_of(touched))]
        end = start + limit
        return touched[start:end].tolist(), end if end < len(touched) else None

    def _have_come(self, pages: Pages, needed: Sequence[int]) -> bool:
        """Whether these pages of the map are in memory; if not, fetch them.

        Raises
        ------
        Offline
            A page cannot be fetched at present.
        """
        absent = [page for page in needed if not pages.is_here(page)]
        pages.want(needed, 0.0)
        if any(map(pages.is_out_of_reach, absent)):
            where = self.config.map_path
            raise Offline(f"{where}: part of the list of cells cannot be reached at present")
        return not absent

    def _rows(self, area: Area | None, start: int, limit: int) -> tuple[Sequence[int], int | None]:
        """Return cells from a catalogue index on, and where the next page begins.

        Only some cells of a large area are tested: a page may have few rows or none without being the last.
        """
        catalogue = self.cache.catalogue
        count = len(catalogue)
        if area is None:
            end = min(start + limit, count)
            return range(start, end), end if end < count else None
        found, _ = catalogue.query(area, LOOKED_AT)
        end = count
        if len(found) > LOOKED_AT:
            end = min(start + LOOKED_AT, count)
            found = np.flatnonzero(touches(area, catalogue.boxes_of(np.arange(start, end)))) + start
        found = found[found.searchsorted(start) :]
        following = int(found[limit]) if len(found) > limit else end
        return found[:limit].tolist(), following if following < count else None

    def _rows_of_pages(
        self, pages: Pages, area: Area | None, start: int, limit: int
    ) -> tuple[Sequence[int], int | None] | None:
        """Return cells of one page of the map from a row on, and the next position; None if it is missing.

        A position in the list is the page's number, shifted by 32 bits, plus the row in that page.

        Raises
        ------
        Offline
            The page cannot be fetched at present.
        """
        listed = pages.of_area(area) if area is not None else range(len(pages))
        number, row = start >> ROW_BITS, start & ((1 << ROW_BITS) - 1)
        at = bisect.bisect_left(listed, number)
        if at == len(listed):
            return (), None
        page = listed[at]
        if not self._have_come(pages, (page,)):
            return None
        cells = pages.cells(page)
        indices = np.arange(cells.start, cells.stop)
        if area is not None:
            indices = indices[touches(area, self.cache.catalogue.boxes_of(indices))]
        indices = indices[indices.searchsorted(cells.start + row * (page == number)) :]
        if len(indices) > limit:
            return indices[:limit].tolist(), page << ROW_BITS | int(indices[limit]) - cells.start
        return indices.tolist(), listed[at + 1] << ROW_BITS if at + 1 < len(listed) else None

    def _changes_since(self, map_version: int) -> _Changes | None:
        """Return the changes, cached for the following pages; None if they are not known."""
        between = map_version, self.cache.catalogue.map_version
        if self._changes is None or self._changes.between != between:
            change = self.map_switch.changes_since(map_version)
            if change is None:
                return None
            touched = {i for cell in change[0] if (i := self.cache.index_of(cell)) is not None}
            if len(touched) < len(change[0]) and not self.cache.catalogue.complete:
                return None  # pages that listed some of them have been dropped
            removed = tuple(map(self.cache.wire_id, change[1]))
            self._changes = _Changes(between, np.array(sorted(touched), dtype=np.intp), removed)
        return self._changes

    def _row(self, index: int) -> messages.MetadataRow:
        catalogue, known = self.cache.catalogue, self.cache.heights
        heights = known.get(index) or (None, None)
        wire_id, size = self.cache.wire_id(catalogue.id(index)), catalogue.source_bytes(index)
        return messages.MetadataRow(wire_id, catalogue.version(index), *catalogue.box(index), size, *heights)

    def stats(self, message: messages.Stats, usage: Usage) -> Generator[None, None, messages.StatsReply]:
        """Answer a request for statistics with the result of a survey, some sessions per step."""
        statistics, rows = self.cache.statistics, list[messages.ClientRow]()
        for one in tuple(self.sessions):
            yield
            rows.append(client_row(one, usage.shares.get(one.slot, Share())))
        return messages.StatsReply(
            message.request,
            self.cache.epoch,
            self.cache.catalogue.map_version,
            dict(statistics.values),
            tuple(rows),
            usage.unknown,
            usage.unknown_bytes,
        )

    def _show(self, message: messages.Show) -> messages.ShownCell:
        cache, catalogue, ledger, heights = (
            self.cache,
            self.cache.catalogue,
            self.cache.ledger,
            self.cache.heights,
        )
        index = cache.index_of(message.id)
        # a cell that left the map is still shown while a process maps it, with version 0
        ids = {message.id, cache.id_prefix + message.id} if index is None else {catalogue.id(index)}
        found = [resident for cell_id in sorted(ids) for resident in ledger.of_cell(cell_id)]
        retired = itertools.islice(ledger.retired.values(), LOOKED_AT)
        found += [one.resident for one in retired if one.resident.key.cell_id in ids]
        shown = tuple(map(self._segment, found))
        if index is None:
            if not found or not message.id:
                hint = "`shmmap ls` lists what is in memory"
                if not catalogue.complete:
                    hint = f"not all of the map is known yet: ask for the area where it lies; {hint}"
                raise UnknownCell(f"the map has no cell {message.id!r}", hint=hint)
            return messages.ShownCell(message.request, found[0].key.cell_id, 0, *found[0].box, 0, shown)
        (cell_id,) = ids
        failures = [failure for key, failure in self.loads.failures.items() if key.cell_id == cell_id]
        z_min, z_max = heights.get(index) or (None, None)
        return messages.ShownCell(
            message.request, cell_id, catalogue.version(index), *catalogue.box(index),
            catalogue.source_bytes(index), shown,
            tuple(key.layer for key in self.loads.by_key if key.cell_id == cell_id),
            "; ".join(f"{failure.code}: {failure.message}" for failure in failures),
            z_min=z_min, z_max=z_max, pinned=self.pins.layers_of(cell_id),
        )  # fmt: skip

    def _cells_page(self, message: messages.ListCells) -> messages.CellsPage:
        found, following = self.cache.ledger.segments.page(message.start, SEGMENTS_PER_PAGE)
        rows = tuple(map(self._row_of_segment, found))
        return messages.CellsPage(message.request, self.cache.epoch, rows, following)

    def _segment(self, resident: Resident) -> messages.CellRow:
        row, holders = self._row_of_segment(resident), self.cache.holders.of(resident)
        return replace(row, id=resident.key.cell_id, segment=resident.name, holders=holders)

    def _row_of_segment(self, resident: Resident) -> messages.CellRow:
        cache = self.cache
        state: CellState = "resident" if cache.is_current(resident) else "stale"
        if resident.name in cache.ledger.retired:
            state = "zombie"
        return messages.CellRow(
            cache.wire_id(resident.key.cell_id), resident.key.layer, resident.version,
            resident.name.removeprefix(cache.segment_prefix), state, resident.nbytes, resident.points,
            resident.box, resident.hits, int(resident.last_use_s * 1e9), resident.load_ns,
            ahead=resident.prefetched and state == "resident",
        )  # fmt: skip

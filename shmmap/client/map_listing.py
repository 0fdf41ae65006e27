# SPDX-License-Identifier: Apache-2.0
"""Lists from the daemon that take several requests: the map's cells, and what is in memory."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Final, NamedTuple, overload

import numpy as np

import shmmap.geometry as geometry
from shmmap.client.session import Session
from shmmap.errors import NoAnswer
from shmmap.protocol import messages
from shmmap.protocol.messages import MetadataRow

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from shmmap.protocol.rows import CellRow

_ROUNDS: Final = 5  # how often a listing is restarted because the map changed meanwhile
_PAGE_ROWS: Final = 10_000


class CellInfo(NamedTuple):
    """One cell of the map; loaded or not.

    ``box`` is (min_x, min_y, max_x, max_y), metres, map frame; ``z_bounds`` is None until the cell is first
    loaded.  ``source_bytes`` is the size of its file, ``version`` the version of its ``points`` layer.
    """

    id: str
    version: int
    box: tuple[float, float, float, float]
    source_bytes: int
    z_bounds: tuple[float, float] | None


class MapListing(Sequence[CellInfo]):
    """Cells of the map in id order, all from one map version; about 90 bytes per cell.

    Attributes
    ----------
    map_version : int
        Pass it as ``since`` next time, to get only the changes.
    since_known : bool
        False: the daemon no longer knew ``since``, and this is the whole list.
    removed : tuple of str
        Ids that left the map after ``since``.
    """

    def __init__(
        self, id_prefix: str, *, map_version: int, since_known: bool, removed: tuple[str, ...]
    ) -> None:
        self._prefix = id_prefix
        self.map_version = map_version
        self.since_known = since_known
        self.removed = removed
        self._ids = bytearray()
        self._ends = array("Q", [0])
        self._versions = array("Q")
        self._boxes = array("d")
        self._source_bytes = array("Q")
        self._z_bounds = array("d")

    def add(self, rows: Iterable[MetadataRow]) -> None:
        """Append one page of the daemon's answer."""
        for row in rows:
            self._ids += row.id.encode()
            self._ends.append(len(self._ids))
            self._versions.append(row.version)
            self._boxes.extend((row.min_x, row.min_y, row.max_x, row.max_y))
            self._source_bytes.append(row.source_bytes)
            self._z_bounds.extend(math.nan if z is None else z for z in (row.z_min, row.z_max))

    @property
    def boxes(self) -> NDArray[np.float64]:
        """Boxes of all cells, (N, 4): min_x, min_y, max_x, max_y, metres, map frame."""
        return np.array(self._boxes).reshape(-1, 4)

    def _info(self, index: int) -> CellInfo:
        cell = self._ids[self._ends[index] : self._ends[index + 1]].decode()
        min_x, min_y, max_x, max_y = self._boxes[4 * index : 4 * index + 4]
        z_min, z_max = self._z_bounds[2 * index : 2 * index + 2]
        return CellInfo(
            cell if cell.startswith("/") else self._prefix + cell,
            self._versions[index],
            (min_x, min_y, max_x, max_y),
            self._source_bytes[index],
            None if math.isnan(z_min + z_max) else (z_min, z_max),
        )

    def __repr__(self) -> str:
        return f"<MapListing of {len(self)} cells, {len(self.removed)} removed>"

    def __len__(self) -> int:
        return len(self._versions)

    def __iter__(self) -> Iterator[CellInfo]:
        return map(self._info, range(len(self)))

    @overload
    def __getitem__(self, index: int) -> CellInfo: ...

    @overload
    def __getitem__(self, index: slice) -> list[CellInfo]: ...

    def __getitem__(self, index: int | slice) -> CellInfo | list[CellInfo]:
        chosen = range(len(self))[index]
        return [self._info(n) for n in chosen] if isinstance(chosen, range) else self._info(chosen)


def list_cells(
    session: Session,
    area: geometry.Area | None,
    since: int | None,
    most: int | None = None,
) -> MapListing:
    """Request all pages of the daemon's list; see `shmmap.Client.metadata`.

    Raises
    ------
    NoAnswer
        No reply before the deadline, or the map changed each time before the last page.
    """
    message = messages.area_to_message(area) if area is not None else None
    for _ in range(_ROUNDS):
        listing: MapListing | None = None
        start: int | None = 0
        while start is not None:
            page = session.ask(
                lambda n, at=start: messages.Metadata(n, message, since, at, _PAGE_ROWS),  # type: ignore[misc]
                messages.MetadataPage,
            )
            if listing is None:
                listing = MapListing(
                    session.welcome.id_prefix,
                    map_version=page.map_version,
                    since_known=page.since_known,
                    removed=tuple(session.welcome.whole_id(cell) for cell in page.removed),
                )
            elif page.map_version != listing.map_version:
                break  # the map was reloaded in between: pages of two versions cannot be combined
            listing.add(page.rows)
            start = page.next if most is None or len(listing) <= most else None
        else:
            assert listing is not None  # noqa: S101  the loop ran at least once
            return listing
    raise NoAnswer("the map kept changing while it was being listed", hint="ask again later")


def list_segments(session: Session) -> list[CellRow]:
    """Request all pages of what is in memory; see `shmmap.Client.list_cells`.

    Raises
    ------
    NoAnswer
        No reply before the deadline, or the daemon was restarted each time before the last page.
    """
    for _ in range(_ROUNDS):
        found: dict[str, CellRow] = {}  # by name: while segments go, one may be on two pages
        epoch, start = 0, 0
        while True:
            page = session.ask(
                lambda n, at=start: messages.ListCells(n, at),  # type: ignore[misc]
                messages.CellsPage,
            )
            if page.epoch != (epoch := epoch or page.epoch):
                break
            found.update((row.segment, row) for row in page.rows)
            if page.next is None:
                return sorted(found.values(), key=lambda row: (row.id, row.layer, row.version))
            start = page.next
    raise NoAnswer("the daemon kept restarting while it listed its cells", hint="ask again later")

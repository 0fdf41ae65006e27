# SPDX-License-Identifier: Apache-2.0
"""The map's list of cells, as the daemon tells it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple, overload

from shmmap.protocol.messages import MetadataRow

__all__ = ["CellInfo", "MapListing"]


class CellInfo(NamedTuple):
    """One cell of the map; loaded or not.

    ``box`` is (min_x, min_y, max_x, max_y), metres, map frame; ``z_bounds`` is None until the cell
    was first loaded; ``source_bytes`` is the size of its file.
    """

    id: str
    version: int
    box: tuple[float, float, float, float]
    source_bytes: int
    z_bounds: tuple[float, float] | None


class MapListing(Sequence[CellInfo]):
    """Cells of the map in id order, all from one map version.

    Attributes
    ----------
    map_version : int
        Give it as ``since`` next time, to be told only what changed.
    since_known : bool
        False: the daemon did not know ``since`` any more, this is the whole list.
    removed : tuple of str
        Ids that left the map after ``since``.
    """

    def __init__(
        self,
        rows: Sequence[MetadataRow],
        id_prefix: str,
        *,
        map_version: int,
        since_known: bool,
        removed: tuple[str, ...],
    ) -> None:
        self._rows = rows
        self._prefix = id_prefix
        self.map_version = map_version
        self.since_known = since_known
        self.removed = removed

    def _info(self, row: MetadataRow) -> CellInfo:
        z_bounds = None if row.z_min is None or row.z_max is None else (row.z_min, row.z_max)
        return CellInfo(
            row.id if row.id.startswith("/") else self._prefix + row.id,
            row.version,
            (row.min_x, row.min_y, row.max_x, row.max_y),
            row.source_bytes,
            z_bounds,
        )

    def __len__(self) -> int:
        return len(self._rows)

    def __iter__(self) -> Iterator[CellInfo]:
        return map(self._info, self._rows)

    @overload
    def __getitem__(self, index: int) -> CellInfo: ...

    @overload
    def __getitem__(self, index: slice) -> list[CellInfo]: ...

    def __getitem__(self, index: int | slice) -> CellInfo | list[CellInfo]:
        if isinstance(index, slice):
            return [self._info(row) for row in self._rows[index]]
        return self._info(self._rows[index])

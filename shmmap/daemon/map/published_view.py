# SPDX-License-Identifier: Apache-2.0
"""View of one version of a published map: its root, and the shards in memory."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from shmmap.daemon.map.catalogue_view import Ready
from shmmap.daemon.map.shard_pages import Page, ShardFetcher, ShardPages
from shmmap.errors import BadRequest
from shmmap.geometry import Area
from shmmap.layers.spec import layer_spec
from shmmap.origin.catalogue import CatalogueChange
from shmmap.origin.map_report import MapFrame
from shmmap.origin.remote.published_index import MILLIMETRES, Root, Shard, published_layer_version
from shmmap.origin.remote.published_object import POINTS, LayerSource, pack_source
from shmmap.origin.spatial_index import touches
from shmmap.segment.version import Source, Stamp

Indices: TypeAlias = NDArray[np.intp]
_Pair: TypeAlias = tuple[int | None, int | None]
"""Numbers of the shards that cover one place in an earlier version and in a later one."""
MM_BYTES: Final = 6
"""Bytes by which a point in memory exceeds one stored in millimetres."""
_NOTHING: Final = np.empty(0, np.intp)


class _Difference(NamedTuple):
    """Indices of cells that differ between two versions; of removed cells in the earlier one."""

    added: list[int]
    removed: list[int]
    changed: list[int]
    moved: list[int]


class PublishedView:
    """The cells of one version of a published map; see `shmmap.daemon.map.catalogue_view.CatalogueView`.

    Parameters
    ----------
    number
        Number of the version.
    known
        Shards that are in memory from the beginning, by number.
    """

    problems: Final = ()
    opened: Final = None

    def __init__(
        self, root: Root, number: int, fetcher: ShardFetcher, known: Mapping[int, Shard], *, max_bytes: int
    ) -> None:
        self.root = root
        self.number = number
        self.pages: ShardPages = ShardPages(root, fetcher, known, max_bytes=max_bytes)
        self.map_version = root.map_version
        self.id_prefix = root.id_prefix
        self.frame_id = root.frame_id
        self.frame = MapFrame(root.origin, root.crs, root.unit_m)
        self.bounds: tuple[float, float, float, float] | None = root.bounds
        self.mean_size = root.mean_m
        self._differing: tuple[Root, list[_Pair]] | None = None
        self._compared: set[_Pair] = set()
        self._found = _Difference([], [], [], [])
        self._changed: tuple[Indices, Indices, Indices, Indices, bool] | None = None

    @cached_property
    def _ready(self) -> dict[str, int]:
        """Builder versions of published layers that this program would build identically."""
        found = {}
        for spec, builder_version in self.root.layers.items():
            try:
                ours = layer_spec(spec)
            except BadRequest:
                continue
            if spec == POINTS or (str(ours) == spec and ours.builder_version == builder_version):
                found[spec] = builder_version
        return found

    def __len__(self) -> int:
        return self.root.cells

    @property
    def complete(self) -> bool:
        """Whether all cells are known."""
        return self.pages.complete

    # --- cells ------------------------------------------------------------------------------------

    def query(self, area: Area, most: int | None = None) -> tuple[Indices, bool]:
        """Return known cells that intersect an area, in id order, and whether these are all."""
        found: list[Indices] = []
        names: list[list[bytes]] = []
        known, count = True, 0
        for number in self.pages.of_area(area):
            page = self.pages.page(number)
            if page is None:
                known = False
                continue
            if most is not None and count > most:
                continue
            rows = np.flatnonzero(touches(area, page.shard.boxes))
            if len(rows):
                found.append(rows + page.first)
                names.append([page.shard.names[row] for row in rows.tolist()])
                count += len(rows)
        if len(found) <= 1:
            return (found[0] if found else _NOTHING), known
        indices = np.concatenate(found)
        if most is None or count <= most:
            indices = indices[np.argsort(np.array([name for some in names for name in some]), kind="stable")]
        return indices, known

    def find(self, cell: str) -> int | None:
        """Return the index of a known cell by its id or a unique base name."""
        name = cell
        if cell.startswith("/"):
            if not cell.startswith(self.id_prefix):
                return None
            name = cell[len(self.id_prefix) :]
        try:
            key = name.encode()
        except UnicodeEncodeError:
            return None
        index = self.pages.find(key)
        if index is None and "/" not in cell:
            index = self.pages.find_base(key)
        return index

    def id(self, index: int) -> str:
        """Return the id of a cell."""
        page, row = self.pages.row(index)
        return page.shard.id(row, self.id_prefix)

    def ids(self, indices: Indices) -> list[str]:
        """Return ids of cells."""
        return [self.id(index) for index in indices.tolist()]

    def box(self, index: int) -> tuple[float, float, float, float]:
        """Return the box of a cell."""
        page, row = self.pages.row(index)
        return page.shard.box(row)

    def boxes_of(self, indices: Indices) -> NDArray[np.float64]:
        """Return the boxes of these cells, (K, 4) float64."""
        return self.pages.boxes_of(indices)

    def version(self, index: int) -> int:
        """Return the 64-bit version of a cell."""
        page, row = self.pages.row(index)
        version = int(page.versions[row])
        if not version:
            version = page.shard.version(row, self.id_prefix)
            page.versions[row] = version
        return version

    def source(self, index: int) -> Source:
        """Return the objects of a cell that this program can use."""
        page, row = self.pages.row(index)
        shard = page.shard
        layers = {
            spec: LayerSource(*shard.layers[spec].name(row), builder_version)
            for spec, builder_version in self._ready.items()
        }
        return pack_source(shard.id(row, self.id_prefix), layers)

    def stamp(self, index: int) -> Stamp:
        """Return the stamp of a cell."""
        page, row = self.pages.row(index)
        return page.shard.stamp(row)

    def set_stamp(self, index: int, stamp: Stamp) -> None:
        """Do nothing: within a version no cell changes."""

    def source_bytes(self, index: int) -> int:
        """Return the size of a cell's points in memory, at least approximately."""
        page, row = self.pages.row(index)
        return int(page.shard.layers[POINTS].raws[row])

    def ready(self, index: int, layer: str) -> Ready | None:
        """Return size and version of a published layer; None if the layer is computed here."""
        builder_version = self._ready.get(layer)
        if builder_version is None:
            return None
        page, row = self.pages.row(index)
        objects = page.shard.layers[layer]
        version, nbytes = self.version(index), int(objects.raws[row])
        if layer != POINTS:
            content = objects.contents[row].tobytes()
            version = published_layer_version(version, layer, builder_version, content)
        elif self.root.encoding == MILLIMETRES:
            nbytes += MM_BYTES * int(page.shard.points[row])
        return Ready(nbytes, version)

    # --- what changed -----------------------------------------------------------------------------

    def changes_from(self, before: object) -> CatalogueChange:
        """Return the difference from another version, as far as both know their cells.

        Each shard is compared once, when it is in memory, so a call for each new page is cheap.
        """
        if not isinstance(before, PublishedView):
            raise TypeError(f"{type(before).__name__} is no version of a published map")
        unknown = CatalogueChange(
            before, self, _NOTHING, _NOTHING, _NOTHING, _NOTHING, same_numbers=False, known=False
        )
        same_ids = before.id_prefix == self.id_prefix
        if self._differing is None or self._differing[0] is not before.root:
            self._compared.clear()
            self._found, self._changed = _Difference([], [], [], []), None
            self._differing = before.root, _differing_shards(before.root, self.root, same_ids=same_ids)
        pairs = self._differing[1]
        theirs = {was: before.pages.page(was) for was, _ in pairs if was is not None}
        ours = {now: self.pages.page(now) for _, now in pairs if now is not None}
        if None in theirs.values():
            return unknown
        for was, now in pairs if self._changed is None else ():
            old = theirs[was] if was is not None else None
            new = ours[now] if now is not None else None
            if (was, now) not in self._compared and (now is None or new is not None):
                self._compared.add((was, now))
                _compare(old, new, self._found, same_ids=same_ids)
        if None in ours.values():
            return unknown
        if self._changed is None:
            # a cell that went to another shard shifts the numbers of others
            same_numbers = not self._found.added and not self._found.removed
            if same_ids and self._found.added and self._found.removed:
                self._note_moved(before)
            added, removed, changed, moved = (np.sort(np.array(some, np.intp)) for some in self._found)
            self._changed = added, removed, changed, moved, same_numbers
        return CatalogueChange(before, self, *self._changed)

    def _note_moved(self, before: PublishedView) -> None:
        """Note as moved the cells that left one shard and appear in another."""
        added, removed, _, moved = self._found
        left = {before.id(index): index for index in removed}
        came = {self.id(index): index for index in added}
        both = left.keys() & came.keys()
        removed[:] = [index for cell, index in left.items() if cell not in both]
        added[:] = [index for cell, index in came.items() if cell not in both]
        moved += [came[cell] for cell in both]


def _differing_shards(old: Root, new: Root, *, same_ids: bool) -> list[_Pair]:
    """Return the pairs of shards that differ between two versions."""

    def by_place(root: Root) -> dict[tuple[int, int], int]:
        return {(row, column): number for number, (row, column) in enumerate(root.keys.tolist())}

    before, after = by_place(old), by_place(new)
    if old.shard_m != new.shard_m:
        return [*((n, None) for n in before.values()), *((None, n) for n in after.values())]
    return [
        (was, now)
        for was, now in ((before.get(place), after.get(place)) for place in {**before, **after})
        if not same_ids
        or was is None
        or now is None
        or old.hashes[was].tobytes() != new.hashes[now].tobytes()
    ]


def _compare(old: Page | None, new: Page | None, found: _Difference, *, same_ids: bool) -> None:
    """Add the cells that differ between two states of a shard to ``found``; None stands for no shard."""
    before = {name: row for row, name in enumerate(old.shard.names)} if old is not None else {}
    after = {name: row for row, name in enumerate(new.shard.names)} if new is not None else {}
    both = before.keys() & after.keys() if same_ids else set[bytes]()
    if new is not None:
        found.added.extend(new.first + row for name, row in after.items() if name not in both)
    if old is not None:
        found.removed.extend(old.first + row for name, row in before.items() if name not in both)
    if old is not None and new is not None:
        for name in both:
            was, row = before[name], after[name]
            if old.shard.box(was) != new.shard.box(row):
                found.moved.append(new.first + row)
            if old.shard.stamp(was) != new.shard.stamp(row):
                found.changed.append(new.first + row)

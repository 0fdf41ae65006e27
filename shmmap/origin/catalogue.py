# SPDX-License-Identifier: Apache-2.0
"""The cells of one map at one moment: ids, boxes, stamps, versions, area queries, changes."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from xxhash import xxh3_64, xxh3_64_intdigest

from shmmap.errors import MapDataError
from shmmap.geometry import Area
from shmmap.large_tables import sparse_zeros
from shmmap.origin.cell_names import CellNames, common_directory
from shmmap.origin.map_layout import OpenedDirectories
from shmmap.origin.map_report import UNKNOWN_FRAME, MapFrame
from shmmap.origin.spatial_index import MadeOfBoxes, SpatialIndex
from shmmap.segment.layout import SourceStamp
from shmmap.segment.version import Source, Stamp, cell_version

Indices = NDArray[np.intp]

# Stamps are hashed in blocks of this many cells, so that one changed stamp costs one block.
_BLOCK_CELLS = 4096
_HASHED_BYTES = 1 << 20

# Cells that are compared at a time, so that no other table is as long as the map.
_COMPARED_CELLS = 1 << 12


class CellIds(Protocol):
    """Cells whose ids are found by index."""

    def ids(self, indices: Indices) -> list[str]:
        """Return the ids of several cells, in the order given."""


@dataclass(frozen=True, slots=True, eq=False)
class CatalogueChange:
    """Differences between two catalogues of a map; indices ascending, which is id order."""

    old: CellIds
    new: CellIds
    added: Indices
    """Cells in the new catalogue only."""
    removed: Indices
    """Cells in the old catalogue only, as indices of the old catalogue."""
    changed: Indices
    """Cells in both with different stamps, so with different versions."""
    moved: Indices
    """Cells in both with different boxes (the metadata was edited), so with different versions."""
    same_numbers: bool
    """Whether an index names the same cell in both catalogues."""
    known: bool = True
    """True if these are all differences: both catalogues were known wherever they differ."""

    def __bool__(self) -> bool:
        return self.count > 0

    @property
    def count(self) -> int:
        """Total number of cells added, removed, changed and moved."""
        return len(self.added) + len(self.removed) + len(self.changed) + len(self.moved)

    @property
    def touched(self) -> Indices:
        """Cells in both whose versions differ."""
        return np.concatenate((self.changed, self.moved))

    def ids(self, how: str, most: int | None = None) -> tuple[str, ...]:
        """Return ids of cells, at most ``most``; ``how`` is added, removed, changed or moved."""
        cells = self.old if how == "removed" else self.new
        return tuple(cells.ids(getattr(self, how)[:most]))


class Catalogue:
    """The cells of one map, numbered 0..n-1 in ascending byte order of their ids.

    Ids and boxes never change.  A stamp may be corrected in place (`set_stamp`) when a loader finds
    that a file changed since the map was scanned; the cell's version and the map version follow.

    Parameters
    ----------
    id_prefix
        Directory that every id starts with, ending in "/".
    names
        (N,) bytes, the rest of each id, ascending and unique.
    boxes
        (N, 4) float64, ``min_x, min_y, max_x, max_y``, metres, map frame.
    stamps
        (N, 3) int64, size in bytes, mtime_ns, ctime_ns.
    problems
        Oddities found while reading the map, one sentence each, for the log and `shmmap status`.
    before
        An earlier state.  What was computed from its ``names`` or ``boxes`` is reused if these are the same
        arrays.
    by_base, made, fixed_digest
        Earlier results for the same names and boxes: `CellNames.by_base`, `SpatialIndex.made` and
        `fixed_digest`.

    Attributes
    ----------
    id_prefix, names, boxes, stamps
        As above; do not write.
    by_base
        Indices in order of base names, see `shmmap.origin.cell_names.order_by_base`.
    made_of_boxes
        Search structure for area queries.
    bounds, mean_size
        Box around all cells, metres, map frame (None if there are no cells), and the mean extent of the cells
        along x and y.
    opened
        Open directories through which the cells' files are read; None: they are read by path.

    Raises
    ------
    MapDataError
        A box is not finite or has its minimum above its maximum.
    """

    frame_id = "map"

    def __init__(
        self,
        *,
        id_prefix: str,
        names: NDArray[np.bytes_],
        boxes: NDArray[np.float64],
        stamps: NDArray[np.int64],
        problems: Sequence[str] = (),
        before: Catalogue | None = None,
        by_base: NDArray[np.int32] | None = None,
        made: MadeOfBoxes | None = None,
        fixed_digest: int | None = None,
    ) -> None:
        self._names: CellNames
        self._index: SpatialIndex
        if before is not None and before._names.names is names and before._names.prefix == id_prefix:
            self._names = before._names
        else:
            self._names = CellNames(id_prefix, names, by_base)
        if before is not None and before._index.boxes is boxes:
            self._index = before._index
        else:
            if made is None:
                self._refuse_bad(boxes)
            self._index = SpatialIndex(boxes, made)
        self.id_prefix, self.names, self.by_base = id_prefix, names, self._names.by_base
        self.boxes, self.made_of_boxes = self._index.boxes, self._index.made
        self.bounds, self.mean_size = self.made_of_boxes.bounds, self.made_of_boxes.mean_size
        self.stamps = stamps
        self._versions = sparse_zeros(len(stamps), np.uint64)  # 0: not computed yet
        self._block_digests: NDArray[np.uint64] | None = None
        self._fixed_digest = fixed_digest
        self._map_version: int | None = None
        self.problems = tuple(problems)
        self.opened: OpenedDirectories | None = None
        self.frame: MapFrame = UNKNOWN_FRAME
        """Transform from the map frame to the inputs' coordinates; set by the reader of the map."""

    def _refuse_bad(self, boxes: NDArray[np.float64]) -> None:
        bad = ~np.isfinite(boxes).all(axis=1) | (boxes[:, :2] > boxes[:, 2:]).any(axis=1)
        if bad.any():
            first = int(np.flatnonzero(bad)[0])
            raise MapDataError(
                f"the box {tuple(boxes[first].tolist())} is not a rectangle",
                path=self.id(first),
                cause="bad_box",
            )

    @classmethod
    def from_cells(
        cls,
        cells: Iterable[tuple[str, tuple[float, float, float, float], SourceStamp]],
        problems: Sequence[str] = (),
    ) -> Catalogue:
        """Build from (id, box, stamp) of each cell, in any order; ids are absolute paths."""
        ordered = sorted(cells, key=lambda cell: os.fsencode(cell[0]))
        prefix = common_directory([cell_id for cell_id, _, _ in ordered])
        return cls(
            id_prefix=prefix,
            names=np.array(
                [os.fsencode(cell_id[len(prefix) :]) for cell_id, _, _ in ordered], dtype=np.bytes_
            ),
            boxes=np.array([box for _, box, _ in ordered], dtype=np.float64).reshape(-1, 4),
            stamps=np.array([stamp for _, _, stamp in ordered], dtype=np.int64).reshape(-1, 3),
            problems=problems,
        )

    def __len__(self) -> int:
        return len(self._names)

    def id(self, index: int) -> str:
        """Return the id of a cell: the absolute path of its file."""
        return self._names.id(index)

    def ids(self, indices: Indices) -> list[str]:
        """Return the ids of several cells, in the order given."""
        return self._names.ids(indices)

    def find(self, cell: str) -> int | None:
        """Return the index of the cell with this full id, id without `id_prefix`, or else base name.

        None if no cell matches.

        Raises
        ------
        BadRequest
            Several cells have this base name.
        """
        return self._names.find(cell)

    def box(self, index: int) -> tuple[float, float, float, float]:
        """Return ``min_x, min_y, max_x, max_y`` of a cell, metres, map frame."""
        min_x, min_y, max_x, max_y = self.boxes[index].tolist()
        return min_x, min_y, max_x, max_y

    def boxes_of(self, indices: Indices) -> NDArray[np.float64]:
        """Return the boxes of cells, (K, 4) float64, each as in `box`."""
        boxes: NDArray[np.float64] = self.boxes[indices]
        return boxes

    def source(self, index: int) -> Source:
        """Return the source of a cell's points: the file whose path is the cell's id."""
        return Source(self.id(index))

    def ready(self, index: int, layer: str) -> None:
        """Return None: no layer of these cells is published, all are computed from files."""
        del index, layer

    def stamp(self, index: int) -> Stamp:
        """Return the last known stamp of a cell's file."""
        return bytes(self.stamps[index].astype("<i8", copy=False).tobytes())

    def source_bytes(self, index: int) -> int:
        """Return the last known size of a cell's file in bytes."""
        return int(self.stamps[index, 0])

    def set_stamp(self, index: int, stamp: Stamp) -> None:
        """Correct a cell's stamp in place; its version and the map version follow.  Cheap at any size."""
        self.stamps[index] = np.frombuffer(stamp, "<i8")
        self._versions[index] = 0
        if self._block_digests is not None:
            block = index // _BLOCK_CELLS
            self._block_digests[block] = self._digest_block(block)
        self._map_version = None

    def version(self, index: int) -> int:
        """Return the 64-bit version of a cell, see `shmmap.segment.version.cell_version`."""
        version = int(self._versions[index])
        if not version:
            version = cell_version(self.id(index), self.stamp(index), self.box(index))
            self._versions[index] = version
        return version

    @property
    def map_version(self) -> int:
        """64-bit version of the whole catalogue: the same after a restart, different after any change.

        The recipe (XXH3, 64 bit, seed 0, little-endian throughout): *fixed* is the hash of
        ``b"shmmap map 1"``, a zero byte, `id_prefix`, a zero byte, all `names` padded with zero bytes
        to the longest, then all min_x, all min_y, all max_x, all max_y as float64.  For each run of
        4096 cells, *block* is the hash of their stamps (size, mtime_ns, ctime_ns as int64).  The
        version is the hash of *fixed* and every *block* as uint64.
        """
        if self._map_version is None:
            if self._block_digests is None:
                blocks = range(-(-len(self) // _BLOCK_CELLS))
                self._block_digests = np.array([self._digest_block(i) for i in blocks], dtype=np.uint64)
            self._map_version = xxh3_64_intdigest(
                self.fixed_digest.to_bytes(8, "little") + self._block_digests.tobytes()
            )
        return self._map_version

    @property
    def fixed_digest(self) -> int:
        """Hash of names and boxes, *fixed* in `map_version`: equal if all names and boxes are equal."""
        if self._fixed_digest is None:
            fixed = xxh3_64(b"shmmap map 1\0" + os.fsencode(self.id_prefix) + b"\0")
            for table in (self.names, self.boxes.T):
                parts = np.ascontiguousarray(table).reshape(-1).view(np.uint8)
                for begin in range(0, len(parts), _HASHED_BYTES):  # others get the interpreter in between
                    fixed.update(parts[begin : begin + _HASHED_BYTES].data)
            self._fixed_digest = fixed.intdigest()
        return self._fixed_digest

    def _digest_block(self, block: int) -> int:
        cells = self.stamps[block * _BLOCK_CELLS : (block + 1) * _BLOCK_CELLS]
        return xxh3_64_intdigest(np.ascontiguousarray(cells).data)

    pages = None
    """None: the whole catalogue is in memory, see `shmmap.daemon.map.catalogue_view.CatalogueView`."""
    complete = True

    def changes_from(self, before: object) -> CatalogueChange:
        """Return the differences from an earlier catalogue of the map."""
        if not isinstance(before, Catalogue):
            raise TypeError(f"{type(before).__name__} is no catalogue of the same kind")
        return compare(before, self)

    def query(self, area: Area, most: int | None = None) -> tuple[Indices, bool]:
        """Return the cells whose box touches ``area``, ascending (which is id order), and True.

        True says that the cells in the area are known.  Borders are closed.  The area's z range is ignored,
        since heights are known only after loading.  If more than ``most`` cells match, the result may be
        incomplete and unordered, but still has more than ``most`` cells.
        """
        return self._index.query(area, most), True


def compare(old: Catalogue, new: Catalogue) -> CatalogueChange:
    """Return the changes from ``old`` to ``new``, without a Python loop over all cells."""
    names = new.names
    same = old.id_prefix == new.id_prefix and (names is old.names or np.array_equal(names, old.names))
    kept = np.full(len(old.names), same)
    nothing = np.empty(0, np.intp)
    added, changed, moved = [nothing], [nothing], [nothing]
    for in_old, in_new in _differing(old, new) if same else _matched(old, new):
        there = in_old >= 0
        added.append(in_new[~there])
        in_old, in_new = in_old[there], in_new[there]
        kept[in_old] = True
        changed.append(in_new[(old.stamps[in_old] != new.stamps[in_new]).any(axis=1)])
        moved.append(in_new[(old.boxes[in_old] != new.boxes[in_new]).any(axis=1)])
    came, removed = np.concatenate(added), np.flatnonzero(~kept)
    return CatalogueChange(
        old,
        new,
        added=came,
        removed=removed,
        changed=np.concatenate(changed),
        moved=np.concatenate(moved),
        same_numbers=not len(came) and not len(removed),
    )


def _differing(old: Catalogue, new: Catalogue) -> Iterator[tuple[Indices, Indices]]:
    """Yield indices of two catalogues of the same names, block by block, without blocks that are the same.

    Nearly all blocks are the same in a reload, and other threads wait for the interpreter lock meanwhile.
    """
    for begin in range(0, len(new), _COMPARED_CELLS):
        cells = slice(begin, begin + _COMPARED_CELLS)
        same_boxes = new.boxes is old.boxes or np.array_equal(new.boxes[cells], old.boxes[cells])
        if not (same_boxes and np.array_equal(new.stamps[cells], old.stamps[cells])):
            block = np.arange(begin, min(begin + _COMPARED_CELLS, len(new)))
            yield block, block


def _matched(old: Catalogue, new: Catalogue) -> Iterator[tuple[Indices, Indices]]:
    """Yield matching indices of old (-1: no such cell) and new catalogue, block by block."""
    for begin in range(0, len(new), _COMPARED_CELLS):
        in_new = np.arange(begin, min(begin + _COMPARED_CELLS, len(new)))
        yield _places(old.names, _below(old.id_prefix, new.id_prefix, new.names[in_new])), in_new


def _below(directory: str, prefix: str, names: NDArray[np.bytes_]) -> NDArray[np.bytes_]:
    """Return the paths ``prefix + name`` relative to a directory; empty for a path outside it."""
    if prefix.startswith(directory):
        between = os.fsencode(prefix[len(directory) :])
        return np.char.add(between, names) if between else names
    between = os.fsencode(directory[len(prefix) :])
    below = np.zeros(len(names), names.dtype)
    if directory.startswith(prefix):
        rest = [name[len(between) :] if name.startswith(between) else b"" for name in names.tolist()]
        below = np.array(rest, np.bytes_)
    return below


def _places(ascending: NDArray[np.bytes_], wanted: NDArray[np.bytes_]) -> Indices:
    """Return the index of each wanted name in an ascending table; -1 if it is missing."""
    if not len(ascending):
        return np.full(len(wanted), -1, np.intp)
    # numpy would copy the whole table to widen it if the wanted names were longer
    narrow = wanted.astype(ascending.dtype)
    places = np.minimum(ascending.searchsorted(narrow), len(ascending) - 1)
    places[ascending[places] != wanted] = -1
    return places


class NoMap:
    """An origin without cells."""

    path = ""

    def load(self, *, fresh: bool = False, before: object | None = None) -> Catalogue:
        """Return an empty catalogue."""
        del fresh, before
        return Catalogue.from_cells([])

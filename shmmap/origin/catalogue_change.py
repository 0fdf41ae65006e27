# SPDX-License-Identifier: Apache-2.0
"""Finds the changes from one state of a map to the next, without another table as long as the map."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = ["CatalogueChange", "CellIds", "Tables", "compare"]

Indices = NDArray[np.intp]
Names = NDArray[np.bytes_]

_BLOCK_CELLS: Final = 1 << 15


class CellIds(Protocol):
    """Cells whose ids are found by index."""

    def ids(self, indices: Indices) -> list[str]:
        """Return the ids of several cells, in the order given."""


class Tables(CellIds, Protocol):
    """The tables of a catalogue that are compared; each as in `Catalogue`."""

    @property
    def id_prefix(self) -> str:
        """Directory that all ids begin with."""

    @property
    def names(self) -> NDArray[np.bytes_]:
        """(N,) bytes, the rest of each id after `id_prefix`."""

    @property
    def boxes(self) -> NDArray[np.float64]:
        """(N, 4): ``min_x, min_y, max_x, max_y``, metres, map frame."""

    @property
    def stamps(self) -> NDArray[np.int64]:
        """(N, 3) int64: size, mtime_ns, ctime_ns of each source."""


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
    known: bool = True
    """True if these are all differences: both catalogues were known wherever they differ."""

    def __bool__(self) -> bool:
        return self.count > 0

    @property
    def count(self) -> int:
        """Total number of cells added, removed, changed and moved."""
        return len(self.added) + len(self.removed) + len(self.changed) + len(self.moved)

    @property
    def same_cells(self) -> bool:
        """Whether an index names the same cell in both catalogues."""
        return self.known and not len(self.added) and not len(self.removed)

    def ids(self, how: str, most: int | None = None) -> tuple[str, ...]:
        """Return ids of cells, at most ``most``; ``how`` is added, removed, changed or moved."""
        cells = self.old if how == "removed" else self.new
        return tuple(cells.ids(getattr(self, how)[:most]))


def compare(old: Tables, new: Tables) -> CatalogueChange:
    """Return the changes from ``old`` to ``new``, without a Python loop over all cells."""
    kept = np.zeros(len(old.names), np.bool_)
    nothing = np.empty(0, np.intp)
    added, changed, moved = [nothing], [nothing], [nothing]
    for in_old, in_new in _matched(old, new):
        there = in_old >= 0
        added.append(in_new[~there])
        in_old, in_new = in_old[there], in_new[there]
        kept[in_old] = True
        changed.append(in_new[(old.stamps[in_old] != new.stamps[in_new]).any(axis=1)])
        moved.append(in_new[(old.boxes[in_old] != new.boxes[in_new]).any(axis=1)])
    return CatalogueChange(
        old,
        new,
        added=np.concatenate(added),
        removed=np.flatnonzero(~kept),
        changed=np.concatenate(changed),
        moved=np.concatenate(moved),
    )


def _matched(old: Tables, new: Tables) -> Iterator[tuple[Indices, Indices]]:
    """Yield matching indices of old (-1: no such cell) and new catalogue, block by block."""
    names = new.names
    same = old.id_prefix == new.id_prefix and (names is old.names or np.array_equal(names, old.names))
    for begin in range(0, len(names), _BLOCK_CELLS):
        in_new = np.arange(begin, min(begin + _BLOCK_CELLS, len(names)))
        if same:
            yield in_new, in_new
        else:
            yield _places(old.names, _below(old.id_prefix, new.id_prefix, names[in_new])), in_new


def _below(directory: str, prefix: str, names: Names) -> Names:
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


def _places(ascending: Names, wanted: Names) -> Indices:
    """Return the index of each wanted name in an ascending table; -1 if it is missing."""
    if not len(ascending):
        return np.full(len(wanted), -1, np.intp)
    # numpy would copy the whole table to widen it if the wanted names were longer
    narrow = wanted.astype(ascending.dtype)
    places = np.minimum(ascending.searchsorted(narrow), len(ascending) - 1)
    places[ascending[places] != wanted] = -1
    return places

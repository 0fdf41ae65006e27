# SPDX-License-Identifier: Apache-2.0
"""What changed from one state of a map to the next, found without a further table as long as the map."""

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
        """Ids of several cells, in the order given."""


class Tables(CellIds, Protocol):
    """What is compared of two catalogues; each as in `Catalogue`."""

    @property
    def id_prefix(self) -> str:
        """What all ids begin with."""

    @property
    def names(self) -> NDArray[np.bytes_]:
        """(N,) bytes, what follows `id_prefix` in each id."""

    @property
    def boxes(self) -> NDArray[np.float64]:
        """(N, 4): ``min_x, min_y, max_x, max_y``, metres, map frame."""

    @property
    def stamps(self) -> NDArray[np.int64]:
        """(N, 3) int64: size, mtime_ns, ctime_ns of each source."""


@dataclass(frozen=True, slots=True, eq=False)
class CatalogueChange:
    """What differs between two catalogues of a map; indices ascending, which is id order."""

    old: CellIds
    new: CellIds
    added: Indices
    """In the new one only."""
    removed: Indices
    """In the old one only; these are indices of the old one."""
    changed: Indices
    """In both with different stamps: another version."""
    moved: Indices
    """In both with different boxes (the metadata was edited): another version, too."""
    known: bool = True
    """These are all: the cells of both were known wherever the two differ."""

    def __bool__(self) -> bool:
        return self.count > 0

    @property
    def count(self) -> int:
        """How many cells there are in all of them."""
        return len(self.added) + len(self.removed) + len(self.changed) + len(self.moved)

    @property
    def same_cells(self) -> bool:
        """Whether indices mean the same cells as before."""
        return self.known and not len(self.added) and not len(self.removed)

    def ids(self, how: str, most: int | None = None) -> tuple[str, ...]:
        """Ids of the cells that were ``how``: added, removed, changed or moved; the first ``most``."""
        cells = self.old if how == "removed" else self.new
        return tuple(cells.ids(getattr(self, how)[:most]))


def compare(old: Tables, new: Tables) -> CatalogueChange:
    """Find what changed from ``old`` to ``new``, without visiting every cell in Python."""
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
    """Yield indices in the old one, -1 where it has no such cell, and in the new one, block by block."""
    names = new.names
    same = old.id_prefix == new.id_prefix and (names is old.names or np.array_equal(names, old.names))
    for begin in range(0, len(names), _BLOCK_CELLS):
        in_new = np.arange(begin, min(begin + _BLOCK_CELLS, len(names)))
        if same:
            yield in_new, in_new
        else:
            yield _places(old.names, _below(old.id_prefix, new.id_prefix, names[in_new])), in_new


def _below(directory: str, prefix: str, names: Names) -> Names:
    """Return the paths ``prefix + name`` as seen from a directory; empty for those that are not below it."""
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
    """Where in an ascending table each name stands; -1 where it does not."""
    if not len(ascending):
        return np.full(len(wanted), -1, np.intp)
    # compared with longer names, the whole table would be copied to make it wider
    narrow = wanted.astype(ascending.dtype)
    places = np.minimum(ascending.searchsorted(narrow), len(ascending) - 1)
    places[ascending[places] != wanted] = -1
    return places

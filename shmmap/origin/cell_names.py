# SPDX-License-Identifier: Apache-2.0
"""The ids of up to millions of cells, without a Python string for each.

All ids begin with the same directory.  The rest of each id is kept in one numpy bytes array in ascending
byte order, which is the order of a C++ ``std::map<std::string, ...>`` and hence Autoware's.
"""

from __future__ import annotations

import os
from bisect import bisect_left, bisect_right
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from shmmap.errors import BadRequest

Names = NDArray[np.bytes_]

# Number of cached lookups: differential requests repeat the same ids, a few hundred or all 20 000 that a
# request may hold.  A dict of three times as many takes 2 ms to grow or to clear.
_REMEMBERED = 20_480
_NAMED_IN_ERRORS = 3

# Names converted to Python objects at a time; ten million would take a gigabyte.
_BLOCK_NAMES = 1 << 15


class CellNames:
    """Ids ``prefix + name`` in ascending order.

    Parameters
    ----------
    prefix
        Directory that every id starts with, ending in "/"; empty if there are no cells.
    names
        (N,) bytes, ascending and unique.
    by_base
        (M,) int32, the result of `order_by_base` for ``names``; None: it is computed now.
    """

    def __init__(self, prefix: str, names: Names, by_base: NDArray[np.int32] | None = None) -> None:
        if len(names) > 1 and not bool((names[:-1] < names[1:]).all()):
            raise ValueError("cell names must be ascending and unique")
        self.prefix = prefix
        self.names = names
        self.by_base = order_by_base(names) if by_base is None else by_base
        self._known: dict[str, int] = {}

    def __len__(self) -> int:
        return len(self.names)

    def id(self, index: int) -> str:
        """Return the full id of one cell."""
        return self.prefix + os.fsdecode(bytes(self.names[index]))

    def ids(self, indices: NDArray[np.intp]) -> list[str]:
        """Return the full ids of several cells, in the order given."""
        prefix = self.prefix
        return [prefix + os.fsdecode(name) for name in self.names[indices].tolist()]

    def find(self, wanted: str) -> int | None:
        """Return the index of the cell with this full id, id without the prefix, or base name.

        A base name must be unique.  Exception: a cell directly below the prefix is found by its base name in
        any case, because that is its id without the prefix.

        Raises
        ------
        BadRequest
            Several cells have this base name.
        """
        index = self._known.get(wanted)
        if index is None:
            index = self._find_id(wanted)
            if index is None and "/" not in wanted:
                index = self._find_base(wanted)
            if index is not None:
                if len(self._known) >= _REMEMBERED:
                    self._known.clear()
                self._known[wanted] = index
        return index

    def _find_id(self, wanted: str) -> int | None:
        if wanted.startswith("/") and not wanted.startswith(self.prefix):
            return None
        found = _positions(self.names, wanted.removeprefix(self.prefix))
        return found.start if found else None

    def _find_base(self, wanted: str) -> int | None:
        key, order = _encoded(wanted), self.by_base
        if key is None or not len(order):
            return None
        # without a separate table of base names, which would take 200 MB for ten million cells
        places = range(len(order))
        first = bisect_left(places, key, key=self._base)
        last = bisect_right(places, key, lo=first, key=self._base)
        if last - first > 1:
            some = ", ".join(self.ids(order[first:last][:_NAMED_IN_ERRORS].astype(np.intp)))
            more = ", ..." if last - first > _NAMED_IN_ERRORS else ""
            raise BadRequest(
                f"{last - first} cells are called {wanted}: {some}{more}", hint="give the full path of one"
            )
        return int(order[first]) if last > first else None

    def _base(self, place: int) -> bytes:
        """Return the base name at position ``place`` in the order of base names."""
        return bytes(self.names[self.by_base[place]]).rpartition(b"/")[2]


def base_names(names: Names) -> Names:
    """Return the part of each name after its last "/"; ``names`` itself if no name has a "/"."""
    if not len(names) or int(np.char.find(names, b"/").max()) < 0:
        return names
    blocks = []
    for begin in range(0, len(names), _BLOCK_NAMES):
        some = names[begin : begin + _BLOCK_NAMES].tolist()
        blocks.append(np.array([name.rpartition(b"/")[2] for name in some], dtype=np.bytes_))
    return np.concatenate(blocks)


def order_by_base(names: Names) -> NDArray[np.int32]:
    """Return the indices that sort ``names`` by base name; equal base names keep their order.

    Empty if no name has a "/", since each name is then its own base name.
    """
    bases = base_names(names)
    if bases is names:
        return np.empty(0, np.int32)
    return np.argsort(bases, kind="stable").astype(np.int32)


def common_directory(paths: Sequence[str]) -> str:
    """Return the longest directory, with its final "/", that all ``paths`` start with; empty if none."""
    if not paths:
        return ""
    # a prefix of the least and the greatest path is a prefix of all
    least, greatest = min(paths), max(paths)
    shared = next((i for i, (a, b) in enumerate(zip(least, greatest, strict=False)) if a != b), len(least))
    return least[: least.rfind("/", 0, shared) + 1]


def _encoded(wanted: str) -> bytes | None:
    """Encode a name as in the tables; None if no file can have this name."""
    try:
        key = os.fsencode(wanted)
    except UnicodeEncodeError:
        return None
    return None if b"\0" in key else key


def _positions(names: Names, wanted: str) -> range:
    """Return the range of positions of ``wanted`` in ascending ``names``."""
    key = _encoded(wanted)
    # numpy pads names with zero bytes, and would widen the whole table to compare it with a longer key
    if key is None or len(key) > names.dtype.itemsize:
        return range(0)
    exact = np.array(key, dtype=names.dtype)
    return range(int(names.searchsorted(exact)), int(names.searchsorted(exact, side="right")))

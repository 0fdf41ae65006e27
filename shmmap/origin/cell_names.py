# SPDX-License-Identifier: Apache-2.0
"""The ids of up to millions of cells, without a Python string for each.

All ids begin with the same directory; what follows is kept in one numpy bytes array in ascending
byte order, which is the order of a C++ ``std::map<std::string, ...>`` and hence Autoware's.
"""

from __future__ import annotations

import os

import numpy as np
from numpy.typing import NDArray

from shmmap.errors import BadRequest

__all__ = ["CellNames"]

Names = NDArray[np.bytes_]

# Lookups remembered; a differential request asks for the same few hundred ids every time.
_REMEMBERED = 1 << 16
_NAMED_IN_ERRORS = 3


class CellNames:
    """Ids ``prefix + name`` in ascending order.

    Parameters
    ----------
    prefix
        What every id starts with, ending in "/" (or empty when there are no cells).
    names
        (N,) bytes, ascending and unique.
    """

    def __init__(self, prefix: str, names: Names) -> None:
        if len(names) > 1 and not bool((names[:-1] < names[1:]).all()):
            raise ValueError("cell names must be ascending and unique")
        self.prefix = prefix
        self.names = names
        self._known: dict[str, int] = {}
        self._by_base: tuple[Names, NDArray[np.intp]] | None = None

    def __len__(self) -> int:
        return len(self.names)

    def id(self, index: int) -> str:
        """Full id of one cell."""
        return self.prefix + os.fsdecode(bytes(self.names[index]))

    def ids(self, indices: NDArray[np.intp]) -> list[str]:
        """Full ids of several cells, in the order given."""
        prefix = self.prefix
        return [prefix + os.fsdecode(name) for name in self.names[indices].tolist()]

    def find(self, wanted: str) -> int | None:
        """Index of the cell with this id, in full or without the prefix, or with this base name.

        A base name must be unique, unless a cell right below the prefix has it: that is its id then.

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
        bases, order = self._bases()
        found = _positions(bases, wanted)
        if len(found) > 1:
            some = ", ".join(self.ids(np.sort(order[found.start : found.stop])[:_NAMED_IN_ERRORS]))
            more = ", ..." if len(found) > _NAMED_IN_ERRORS else ""
            raise BadRequest(
                f"{len(found)} cells are called {wanted}: {some}{more}", hint="give the full path of one"
            )
        return int(order[found.start]) if found else None

    def _bases(self) -> tuple[Names, NDArray[np.intp]]:
        """Base names in ascending order, and whose they are; made at the first use."""
        if self._by_base is None:
            if len(self.names) and int(np.char.find(self.names, b"/").max()) < 0:
                self._by_base = self.names, np.arange(len(self.names))
            else:
                bases = np.array([name.rpartition(b"/")[2] for name in self.names.tolist()], dtype=np.bytes_)
                order = np.argsort(bases, kind="stable")
                self._by_base = bases[order], order
        return self._by_base


def _positions(names: Names, wanted: str) -> range:
    """Where ``wanted`` stands in ascending ``names``."""
    try:
        key = os.fsencode(wanted)
    except UnicodeEncodeError:
        return range(0)
    # numpy pads with zero bytes, and would widen the whole table to compare it with a longer key
    if len(key) > names.dtype.itemsize or b"\0" in key:
        return range(0)
    exact = np.array(key, dtype=names.dtype)
    return range(int(names.searchsorted(exact)), int(names.searchsorted(exact, side="right")))

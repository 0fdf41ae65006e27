# SPDX-License-Identifier: Apache-2.0
"""Sorted set of chunk keys, searched by area and iterated over in parts."""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections.abc import Iterable, Sequence
from typing import Final, TypeAlias

from shmmap.chunks.voxels import ChunkKey

__all__ = ["EVERYWHERE", "KeyIndex", "KeyRange", "merged_part"]

KeyRange: TypeAlias = tuple[ChunkKey, ChunkKey]
"""The least and the greatest key along each axis, both included."""

_FAR: Final = 1 << 62
EVERYWHERE: Final[KeyRange] = (ChunkKey(-_FAR, -_FAR, -_FAR), ChunkKey(_FAR, _FAR, _FAR))


class KeyIndex:
    """A set of keys, sorted by x, then y, then z.

    Parameters
    ----------
    keys
        Initial content.
    """

    def __init__(self, keys: Iterable[ChunkKey] = ()) -> None:
        self._xs: list[int] = []
        self._columns: dict[int, list[ChunkKey]] = {}  # by x, each sorted
        self._keys: set[ChunkKey] = set(keys)
        for key in sorted(self._keys):
            if key.x not in self._columns:
                self._xs.append(key.x)
                self._columns[key.x] = []
            self._columns[key.x].append(key)

    def __len__(self) -> int:
        return len(self._keys)

    def __contains__(self, key: ChunkKey) -> bool:
        return key in self._keys

    def add(self, key: ChunkKey) -> None:
        """Add a key, unless it is in the set."""
        if key in self._keys:
            return
        self._keys.add(key)
        column = self._columns.get(key.x)
        if column is None:
            column = self._columns[key.x] = []
            insort(self._xs, key.x)
        insort(column, key)

    def discard(self, key: ChunkKey) -> None:
        """Remove a key, if it is in the set."""
        if key not in self._keys:
            return
        self._keys.remove(key)
        column = self._columns[key.x]
        del column[bisect_left(column, key)]
        if not column:
            del self._columns[key.x]
            del self._xs[bisect_left(self._xs, key.x)]

    def part(
        self, after: ChunkKey | None, within: KeyRange, most: int
    ) -> tuple[list[ChunkKey], ChunkKey | None]:
        """Return the next keys of a range, and the key after which to continue.

        Parameters
        ----------
        after
            Keys up to this one are left out; None: begin with the first key.
        most
            Most keys and columns to examine, whether in the range or not.

        Returns
        -------
        keys
            Sorted.
        last
            Pass it as ``after`` to continue; None at the end.
        """
        low, high = within
        found: list[ChunkKey] = []
        at = bisect_left(self._xs, low.x if after is None else max(low.x, after.x))
        for number in range(at, len(self._xs)):
            x = self._xs[number]
            if x > high.x:
                break
            column = self._columns[x]
            first = bisect_left(column, (x, low.y, low.z))
            if after is not None and after.x == x:
                first = max(first, bisect_right(column, after))
                if first == len(column):
                    continue
            for place in range(first, len(column)):
                key = column[place]
                if key.y > high.y:
                    break
                if low.z <= key.z <= high.z:
                    found.append(key)
                most -= 1
                if most <= 0:
                    return found, key
            most -= 1
            if most <= 0:
                return found, ChunkKey(x, _FAR, _FAR)
        return found, None


def merged_part(
    indexes: Sequence[KeyIndex], after: ChunkKey | None, within: KeyRange, most: int
) -> tuple[list[ChunkKey], ChunkKey | None]:
    """Return the next keys that are in any of these indexes; as `KeyIndex.part`."""
    parts = [index.part(after, within, most) for index in indexes]
    if len(parts) == 1:
        return parts[0]
    last = min((end for _, end in parts if end is not None), default=None)
    keys = {key for part, _ in parts for key in part if last is None or key <= last}
    return sorted(keys), last

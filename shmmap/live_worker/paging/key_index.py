# SPDX-License-Identifier: Apache-2.0
"""Sorted set of chunk keys, searched by area and iterated over in parts."""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections.abc import Iterable, Sequence
from typing import Final, TypeAlias

from shmmap.chunks.voxels import ChunkKey

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
        self._keys = set(keys)
        self._sorted = sorted(self._keys)

    def __len__(self) -> int:
        return len(self._keys)

    def add(self, key: ChunkKey) -> None:
        """Add a key, unless it is in the set."""
        if key not in self._keys:
            self._keys.add(key)
            insort(self._sorted, key)

    def discard(self, key: ChunkKey) -> None:
        """Remove a key, if it is in the set."""
        if key in self._keys:
            self._keys.remove(key)
            del self._sorted[bisect_left(self._sorted, key)]

    def part(
        self, after: ChunkKey | None, within: KeyRange, most: int
    ) -> tuple[list[ChunkKey], ChunkKey | None]:
        """Return the next keys of a range, and the key after which to continue.

        Parameters
        ----------
        after
            Keys up to this one are left out; None: begin with the first key.
        most
            Most keys to examine, whether in the range or not.

        Returns
        -------
        keys
            Sorted.
        last
            Pass it as ``after`` to continue; None at the end.
        """
        low, high = within
        keys = self._sorted
        found: list[ChunkKey] = []
        at = bisect_left(keys, low)
        if after is not None:
            at = max(at, bisect_right(keys, after))
        for _ in range(most):
            if at == len(keys) or keys[at].x > high.x:
                return found, None
            key = keys[at]
            if low.y <= key.y <= high.y:
                if low.z <= key.z <= high.z:
                    found.append(key)
                at += 1
            else:  # to the range's first place with this x, or with the next one
                at = bisect_left(keys, (key.x + (key.y > high.y), low.y, low.z), at)
        return found, keys[at - 1]


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

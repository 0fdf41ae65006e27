# SPDX-License-Identifier: Apache-2.0
"""What was evicted to make room, remembered for a while: is it loaded again, the cache was too small.

The same idea as the ghost lists of ARC (Megiddo and Modha, FAST 2003), used for telling only.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Final

from shmmap.daemon.records import Key

__all__ = ["EvictionHistory"]

LIMIT: Final = 1 << 14


class EvictionHistory:
    """The last keys that were evicted to make room, at most 16384 of them."""

    def __init__(self) -> None:
        self._versions: OrderedDict[Key, int] = OrderedDict()  # a dict finds its oldest one slowly

    def __len__(self) -> int:
        return len(self._versions)

    def evicted(self, key: Key, version: int) -> None:
        """Note that this version made room for others."""
        self._versions.pop(key, None)
        self._versions[key] = version
        if len(self._versions) > LIMIT:
            self._versions.popitem(last=False)

    def loaded(self, key: Key, version: int) -> bool:
        """Whether a load brought back just what had been evicted to make room."""
        return self._versions.pop(key, None) == version

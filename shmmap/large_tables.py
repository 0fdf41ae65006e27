# SPDX-License-Identifier: Apache-2.0
"""Dictionaries and arrays for large maps, without a single operation that takes long."""

from __future__ import annotations

import contextlib
import math
import mmap
from collections.abc import Hashable, Iterable, Iterator, MutableMapping
from typing import Any, Final, TypeVar, overload

import numpy as np
from numpy.typing import DTypeLike, NDArray

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")
T = TypeVar("T")
FEW: Final = 2048
"""Most entries in one dict; splitting such a dict takes a fifth of a millisecond."""
_SHARDS: Final = 64
_RAISE: Final = object()


class ShardedDict(MutableMapping[K, V]):
    """A mapping like a dict, but unordered."""

    __slots__ = ("_shards",)

    def __init__(self) -> None:
        self._shards: list[dict[K, V]] = [{}]

    def _of(self, key: K) -> dict[K, V]:
        return self._shards[hash(key) % len(self._shards)]

    def _share_out(self) -> None:
        entries, self._shards = self._shards[0], [{} for _ in range(_SHARDS)]
        for key, value in entries.items():
            self._of(key)[key] = value

    def __getitem__(self, key: K) -> V:
        return self._of(key)[key]

    def __setitem__(self, key: K, value: V) -> None:
        shard = self._of(key)
        shard[key] = value
        if len(shard) > FEW and len(self._shards) == 1:
            self._share_out()

    def __delitem__(self, key: K) -> None:
        del self._of(key)[key]

    @overload
    def get(self, key: K, default: None = None) -> V | None: ...

    @overload
    def get(self, key: K, default: V | T) -> V | T: ...

    def get(self, key: K, default: Any = None) -> Any:
        """Return the value of a key, or ``default``."""
        return self._of(key).get(key, default)

    @overload
    def pop(self, key: K) -> V: ...

    @overload
    def pop(self, key: K, default: V | T) -> V | T: ...

    def pop(self, key: K, default: Any = _RAISE) -> Any:
        """Remove a key; return its value, or ``default`` if there is one, else KeyError is raised."""
        return self._of(key).pop(key) if default is _RAISE else self._of(key).pop(key, default)

    def popitem(self) -> tuple[K, V]:
        """Remove any entry and return it; KeyError if there is none."""
        for shard in self._shards:
            if shard:
                return shard.popitem()
        raise KeyError("it is empty")

    def among(self, keys: Iterable[K]) -> list[K]:
        """Return which of many keys are in it."""
        shards = self._shards
        count = len(shards)
        return [key for key in keys if key in shards[hash(key) % count]]

    def __bool__(self) -> bool:
        return any(self._shards)

    def __contains__(self, key: object) -> bool:
        return key in self._shards[hash(key) % len(self._shards)]

    def __iter__(self) -> Iterator[K]:
        for shard in self._shards:
            yield from shard

    def walk(self) -> Iterator[K]:
        """Yield the keys; keys added during the walk may be left out, removed ones may still be yielded."""
        for shard in self._shards:
            yield from list(shard)

    def __len__(self) -> int:
        return sum(map(len, self._shards))


SMALL_BYTES: Final = 1 << 21
"""Size below which numpy requests no huge pages, and a separate mapping is not worthwhile."""


def sparse_zeros(shape: int | tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """Return an array of zeros whose memory is allocated in small pages, as it is written."""
    nbytes = math.prod(shape if isinstance(shape, tuple) else (shape,)) * np.dtype(dtype).itemsize
    if nbytes < SMALL_BYTES:
        return np.zeros(shape, dtype)
    memory = mmap.mmap(-1, nbytes, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    with contextlib.suppress(OSError):  # a kernel without huge pages
        memory.madvise(mmap.MADV_NOHUGEPAGE)
    return np.frombuffer(memory, dtype).reshape(shape)

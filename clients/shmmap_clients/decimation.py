# SPDX-License-Identifier: Apache-2.0
"""A stream of any length in bounded memory: every k-th of its values, evenly from beginning to end."""

from __future__ import annotations

from typing import Final, Generic, TypeVar

__all__ = ["KEPT", "Decimated"]

KEPT: Final = 4096

T = TypeVar("T")


class Decimated(Generic[T]):
    """Keeps all values until there are ``most``, from then on every second, fourth, eighth, ... one.

    Parameters
    ----------
    most
        How many values are kept at most; at least 2.
    """

    def __init__(self, most: int = KEPT) -> None:
        self._most = most
        self._stride = 1
        self._count = 0
        self.values: list[T] = []

    def add(self, value: T) -> None:
        """Take the next value of the stream."""
        if self._count % self._stride == 0:
            if len(self.values) == self._most:
                del self.values[1::2]
                self._stride *= 2
            if self._count % self._stride == 0:
                self.values.append(value)
        self._count += 1

# SPDX-License-Identifier: Apache-2.0
"""Objects that a ``with`` block closes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TypeVar

_Self = TypeVar("_Self", bound="ClosedAtEnd")


class ClosedAtEnd(ABC):
    """An object that is closed at the end of a ``with`` block."""

    def __enter__(self: _Self) -> _Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @abstractmethod
    def close(self) -> None:
        """End what it has begun."""

# SPDX-License-Identifier: Apache-2.0
"""The interface by which long work reports its progress."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """Receives the progress of work on points, cells or objects.

    Its methods are called from one thread, ``advance`` at least a few times a second.
    """

    def stage(self, name: str, total: int) -> None:
        """Begin a stage of ``total`` items; 0 if unknown."""

    def advance(self, count: int) -> None:
        """Count ``count`` further items as done."""

    def done(self, count: int) -> None:
        """End the work, with ``count`` items done."""


class NoProgress:
    """Shows nothing."""

    def stage(self, name: str, total: int) -> None:
        """Ignore a stage."""

    def advance(self, count: int) -> None:
        """Ignore items."""

    def done(self, count: int) -> None:
        """Ignore the end."""

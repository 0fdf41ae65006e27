# SPDX-License-Identifier: Apache-2.0
"""How a long run tells how far it is."""

from __future__ import annotations

from typing import Protocol

__all__ = ["NoProgress", "Progress"]


class Progress(Protocol):
    """Hears what a run is doing; called from one thread, a few times a second at least."""

    def stage(self, name: str, total: int) -> None:
        """A stage begins, of ``total`` points; 0 where that is not known."""

    def advance(self, points: int) -> None:
        """So many more points are done."""

    def done(self, points: int) -> None:
        """Everything is done."""


class NoProgress:
    """Tells nobody."""

    def stage(self, name: str, total: int) -> None:
        """A stage begins."""

    def advance(self, points: int) -> None:
        """So many more points are done."""

    def done(self, points: int) -> None:
        """Everything is done."""

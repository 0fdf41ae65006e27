# SPDX-License-Identifier: Apache-2.0
"""No map: for a daemon that keeps live maps alone."""

from __future__ import annotations

from shmmap.origin.catalogue import Catalogue

__all__ = ["NoMap"]


class NoMap:
    """An origin without cells: whatever is asked for is not there."""

    path = ""

    def load(self, *, fresh: bool = False, before: object | None = None) -> Catalogue:
        """An empty catalogue."""
        del fresh, before
        return Catalogue.from_cells([])

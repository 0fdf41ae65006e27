# SPDX-License-Identifier: Apache-2.0
"""What every place that cells come from offers."""

from __future__ import annotations

from typing import Protocol

from shmmap.origin.catalogue import Catalogue

__all__ = ["MapOrigin"]


class MapOrigin(Protocol):
    """Where the cells of one map come from.

    A cell is read by a loader.  What cannot be reached at present raises `Offline` there: the cell is
    ``offline`` until it is tried again.
    """

    @property
    def path(self) -> str:
        """The map as a person would name it."""

    def load(self, *, fresh: bool = False, before: object | None = None) -> Catalogue:
        """Find out which cells there are now.

        ``fresh`` looks at every file's stamp, where a cached catalogue might do otherwise.  What has not
        changed since ``before``, an earlier state, may be shared with it.

        Raises
        ------
        MapMissing, MapDataError
            There is no map, or none that can be served.
        Offline
            Where it comes from cannot be reached at present.
        """

# SPDX-License-Identifier: Apache-2.0
"""What reads the sources of an origin's cells, in loaders and preparing processes; files are one kind."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final, Protocol

from shmmap.layers.contract import Box
from shmmap.layers.points import LAYER, build_points
from shmmap.layers.sources import CellSource, read_source
from shmmap.layers.spec import LayerSpec
from shmmap.segment.layout import SegmentHeader, SourceStamp
from shmmap.segment.source import Source
from shmmap.segment.version import Stamp

if TYPE_CHECKING:
    from shmmap.layers.derive import CellJob

__all__ = ["FILES", "Fetcher", "Files", "SourceReader"]

REPLACED: Final = "another directory has the map's name now: `shmmap reload` reads it"


class Fetcher(Protocol):
    """Fetches what several jobs need at once, before they are worked on one after the other.

    What cannot be fetched is an error of whatever reads it then.
    """

    @property
    def fd(self) -> int:
        """Readable when `done` may have an answer."""

    def begin(self, number: int, spec: LayerSpec, job: CellJob) -> None:
        """Begin to fetch what a layer of a cell is made from; returns at once."""

    def done(self) -> int | None:
        """Return the number of a job for which all is fetched, or will not come; None: there is none."""


class SourceReader(Protocol):
    """Reads sources by the words of the origin that named them.

    What cannot be reached at present raises `shmmap.errors.Offline`.
    """

    @property
    def fetcher(self) -> Fetcher | None:
        """Fetches for several jobs at once; None: each is read when it is worked on."""

    def stamp(self, source: Source) -> Stamp | None:
        """Return the state that a source is in; None where that cannot be found out."""

    def read(self, source: Source, box: Box, needs: Sequence[str] | None) -> CellSource:
        """Read the columns that a layer needs (None: all) of a cell's points.

        Raises
        ------
        MapDataError
            It cannot be read, or is too large.
        """

    def fill(
        self,
        spec: LayerSpec,
        job: CellJob,
        fd: int,
        *,
        reserve: Callable[[int], None] | None,
        warn: Callable[[str], None],
    ) -> SegmentHeader | None:
        """Fill an empty segment file with a layer that is there as it is; None: it has to be computed.

        ``points`` always are.  Parameters and errors are those of `shmmap.layers.making.make_layer`.
        """

    def named(self, message: str) -> str:
        """Name sources in a message as a person knows them."""

    def explain(self, source: Source, message: str) -> str:
        """Say why a source could not be read, in such words."""

    def take_counts(self) -> tuple[int, ...]:
        """Return counts of objects read since the last call, in the order of `OBJECTS_READ`; empty: none."""


class Files:
    """Sources that are PCD files.

    Parameters
    ----------
    at
        Says where to find what a path names.
    named
        Names paths in a message as they were given.
    """

    fetcher = None

    def __init__(self, at: Callable[[str], str] = str, named: Callable[[str], str] = str) -> None:
        self._at, self._named = at, named

    def stamp(self, source: Source) -> Stamp | None:
        """State of the file, as ``stat`` gives it; None where it cannot be looked at."""
        try:
            return SourceStamp.of(os.stat(self._at(source.name))).token
        except OSError:
            return None

    def read(self, source: Source, box: Box, needs: Sequence[str] | None) -> CellSource:
        """Read the file, see `shmmap.layers.sources.read_source`."""
        return read_source(self._at(source.name), box, needs)

    def fill(
        self,
        spec: LayerSpec,
        job: CellJob,
        fd: int,
        *,
        reserve: Callable[[int], None] | None,
        warn: Callable[[str], None],
    ) -> SegmentHeader | None:
        """Stream the file into the segment, for ``points`` alone."""
        if spec.kind.name != LAYER:
            return None
        return build_points(
            self._at(job.source.name),
            fd,
            cell_id=job.cell_id,
            box=job.box,
            frame_id=job.frame_id,
            reserve=reserve,
            warn=warn,
        )

    def named(self, message: str) -> str:
        """Name files by their paths."""
        return self._named(message)

    def explain(self, source: Source, message: str) -> str:
        """Name files by their paths, and say whether another directory has the map's name now."""
        place = self._at(source.name)
        if place != source.name and self.stamp(source) is None and os.path.exists(source.name):
            return f"{source.name}: {REPLACED}"
        return self._named(message)

    def take_counts(self) -> tuple[int, ...]:
        """Return nothing: files are not objects."""
        return ()


FILES: Final = Files()
"""Files by their paths."""

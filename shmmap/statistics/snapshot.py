# SPDX-License-Identifier: Apache-2.0
"""Content of the statistics segment at one moment."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Literal, TypeVar

from shmmap.errors import SegmentCorrupt
from shmmap.statistics.counters import Counter, Histogram
from shmmap.statistics.identity import DaemonIdentity, DaemonState
from shmmap.statistics.layout import Header, State

if TYPE_CHECKING:
    import msgspec

    from shmmap.protocol.rows import CellRow, ClientRow, LiveMapRow

__all__ = ["Snapshot"]

_Row = TypeVar("_Row", bound="msgspec.Struct")


class Snapshot:
    """The statistics at one moment.

    Attributes
    ----------
    state : str
        ``healthy``; ``starting`` (it beats, but does not listen yet); ``stopped`` (SIGSTOP, a debugger);
        ``hung`` (runs, but has not beaten for 5 s); ``dead`` (the process is gone and left its segment);
        ``absent`` (no segment: never started, or stopped cleanly).  All but ``absent`` come with an identity.
    identity : DaemonIdentity or None
        The daemon that wrote the statistics; None when absent.
    beat_age_s : float
        Seconds since the daemon last wrote; infinite when absent.
    beat_monotonic_ns : int
        Time of that write, CLOCK_MONOTONIC.
    rows_missing : int
        Number of cells for which the table had no room.
    size_bytes : int
        Memory of the segment.
    """

    def __init__(
        self,
        state: DaemonState | Literal["absent"],
        identity: DaemonIdentity | None,
        header: Header | None = None,
        values: State | None = None,
        *,
        beat_age_s: float = float("inf"),
        size_bytes: int = 0,
        rows: bytes = b"",
        clients: bytes = b"",
        live: bytes = b"",
    ) -> None:
        self.identity = identity
        self.beat_age_s = beat_age_s
        self.beat_monotonic_ns = values.beat_monotonic_ns if values is not None else 0
        self.rows_missing = values.rows_missing if values is not None else 0
        self.size_bytes = size_bytes
        self._header = header
        self._values = values
        self._rows = rows
        self._clients = clients
        self._live = live
        self.state: DaemonState | Literal["absent"] = state
        if state == "healthy" and self.counters.get("starting"):
            self.state = "starting"

    @cached_property
    def counters(self) -> dict[str, int]:
        """Values of the counters by name."""
        if self._header is None or self._values is None:
            return {}
        names = (counter.name for counter in self._header.counters)
        return dict(zip(names, self._values.values, strict=False))

    @property
    def descriptions(self) -> tuple[Counter, ...]:
        """Descriptions of the counters, in the daemon's order."""
        return self._header.counters if self._header is not None else ()

    @property
    def histogram_descriptions(self) -> tuple[Counter, ...]:
        """Descriptions of the histograms, in the daemon's order."""
        return self._header.histograms if self._header is not None else ()

    @cached_property
    def histograms(self) -> dict[str, Histogram]:
        """Histograms by name."""
        if self._header is None or self._values is None:
            return {}
        step = 1 + self._header.bucket_count
        values = self._values.histograms
        return {
            description.name: Histogram.of(values[index * step : (index + 1) * step])
            for index, description in enumerate(self._header.histograms)
            if (index + 1) * step <= len(values)
        }

    @cached_property
    def cells(self) -> list[CellRow]:
        """The segments the daemon keeps, in id order, then layer and version.

        A row that the daemon was changing at that moment (it was stopped during a write) is left out.
        """
        from shmmap.protocol.rows import CellRow

        step = self._header.row_bytes if self._header is not None else 0
        return sorted(_in_use(CellRow, self._rows, step), key=lambda row: (row.id, row.layer, row.version))

    @cached_property
    def clients(self) -> list[ClientRow]:
        """The clients in the table, which may lack room for all, in order of arrival."""
        from shmmap.protocol.rows import ClientRow

        step = self._header.client_row_bytes if self._header is not None else 0
        return _in_use(ClientRow, self._clients, step)

    @cached_property
    def live(self) -> list[LiveMapRow]:
        """The live maps that the daemon keeps."""
        if not self._live.strip(b"\0"):
            return []  # saves the import: most daemons keep no live maps
        from shmmap.protocol.rows import LiveMapRow

        step = self._header.live_row_bytes if self._header is not None else 0
        return _in_use(LiveMapRow, self._live, step)


def _in_use(kind: type[_Row], data: bytes, step: int) -> list[_Row]:
    """Return the rows of a table that are in use, except those that were being changed."""
    from shmmap.statistics.rows import unpack_row

    found = []
    view = memoryview(data)
    for at in range(0, len(view) - step + 1, step) if step else ():
        try:
            row = unpack_row(kind, view[at : at + step])
        except SegmentCorrupt:
            continue
        if row is not None:
            found.append(row)
    return found

# SPDX-License-Identifier: Apache-2.0
"""Segments as rows of the statistics."""

from __future__ import annotations

from dataclasses import dataclass

from shmmap.daemon.records import Resident
from shmmap.protocol.rows import CellRow, CellState
from shmmap.statistics.writer import StatisticsWriter

__all__ = ["CellRows"]


@dataclass(eq=False, slots=True)
class CellRows:
    """Shows segments.

    Parameters
    ----------
    id_prefix, segment_prefix
        What cell ids and segment names are shown without.
    """

    statistics: StatisticsWriter
    id_prefix: str
    segment_prefix: str

    def show(self, resident: Resident, state: CellState) -> None:
        """Show a segment as it is now."""
        self.statistics.cell_changed(resident.name, self.row(resident, state))

    def row(self, resident: Resident, state: CellState) -> CellRow:
        """Return the row of a segment."""
        return CellRow(
            resident.key.cell_id.removeprefix(self.id_prefix),
            resident.key.layer,
            resident.version,
            resident.name.removeprefix(self.segment_prefix),
            state,
            resident.nbytes,
            resident.points,
            resident.box,
            resident.hits,
            int(resident.last_use_s * 1e9),
            resident.load_ns,
            ahead=resident.prefetched and state == "resident",
        )

    def hide(self, name: str) -> None:
        """There is no segment of this name any more."""
        self.statistics.cell_removed(name)

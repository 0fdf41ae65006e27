# SPDX-License-Identifier: Apache-2.0
"""The loop of the program: a scan, the window around its pose, what the map does not explain."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from shmmap import BadRequest, MapWindow, ShmmapError, WindowUpdate
from shmmap_clients.compare_map_filter.filter import CompareMapFilter, Comparison
from shmmap_clients.scans.scan_sequence import Scan

__all__ = ["ComparedScan", "compare_drive"]


@dataclass(frozen=True, slots=True, eq=False)
class ComparedScan:
    """A scan and what came of it.

    Attributes
    ----------
    scan, comparison
        The scan, sensor frame, and which of its points are kept.
    missing
        What of the window was not there when it was compared, in words; empty where it was complete.
    """

    scan: Scan
    comparison: Comparison
    missing: str = ""


def compare_drive(
    scans: Iterable[Scan],
    window: MapWindow,
    compare: CompareMapFilter,
    *,
    first_wait_s: float,
    wait_s: float | None,
) -> Iterator[ComparedScan]:
    """Compare scan after scan.

    Parameters
    ----------
    scans
        With poses.
    window
        Of the rule's layer.
    first_wait_s, wait_s
        How long the first scan and each later one may wait for the window's cells; None: not at all.

    Raises
    ------
    BadRequest
        A scan has no pose.
    ShmmapError
        The daemon cannot be asked, and no cell was ever there.
    """
    patience: float | None = first_wait_s
    for scan in scans:
        T = scan.T_map_sensor
        if T is None:
            raise BadRequest(f"scan {scan.name} has no pose", hint="give poses with --poses FILE")
        update = window.move_to(float(T[0, 3]), float(T[1, 3]), wait=patience)
        error = window.error
        # all from one state of the window: it may ask again while the scan is compared
        cells = (*update.added, *update.kept, *update.changed)
        if error is not None and not cells:
            raise error
        patience = wait_s
        comparison = compare.use_cells(cells).apply(scan.xyz, T)
        missing = _missing(update, error)
        del update, cells  # what leaves the window is not held until the next scan has come
        yield ComparedScan(scan, comparison, missing)


def _missing(update: WindowUpdate, error: ShmmapError | None) -> str:
    reasons = Counter(failure.code for failure in update.failed)
    if update.pending:
        reasons["still loading"] = len(update.pending)
    words = [f"{count} cells {reason}" for reason, count in reasons.items()]
    return ", ".join(words if error is None else [*words, str(error)])

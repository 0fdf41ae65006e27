# SPDX-License-Identifier: Apache-2.0
"""The loop of the program: a scan, the window at its pose, and the scan on its way into the map."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from shmmap import BadRequest, Counts, LiveMapper
from shmmap_clients.scans.scan_sequence import Scan

__all__ = ["MappedScan", "map_drive"]


@dataclass(frozen=True, slots=True, eq=False)
class MappedScan:
    """A scan that was sent.

    Attributes
    ----------
    scan
        As it came.
    number
        Of this mapper's scans.
    counts
        What became of its points.
    on_their_way
        Scans that were sent and are not applied, this one included.
    add_s
        How long marking and sending it took, with waiting for room.
    """

    scan: Scan
    number: int
    counts: Counts
    on_their_way: int
    add_s: float


def map_drive(scans: Iterable[Scan], mapper: LiveMapper) -> Iterator[MappedScan]:
    """Map scan after scan.

    Parameters
    ----------
    scans
        With poses.
    mapper
        What sends scans to the map, whose window follows them.

    Raises
    ------
    BadRequest
        A scan has no pose.
    ShmmapError
        The daemon does not take it.
    """
    for scan in scans:
        T = scan.T_map_sensor
        if T is None:
            raise BadRequest(f"scan {scan.name} has no pose", hint="give poses with --poses FILE")
        begin_s = time.perf_counter()
        number = mapper.add(scan.xyz, T)
        add_s = time.perf_counter() - begin_s
        yield MappedScan(scan, number, mapper.counts, max(0, number - mapper.applied), add_s)

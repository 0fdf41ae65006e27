# SPDX-License-Identifier: Apache-2.0
"""Scans as a program's option names them: a directory, or the address of a publisher."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import replace

from shmmap import BadRequest
from shmmap_clients.scans.scan_file import ScanReader
from shmmap_clients.scans.scan_sequence import Scan, ScanSequence
from shmmap_clients.scans.scan_stream import ScanSubscriber
from shmmap_clients.scans.trajectory import read_trajectory
from shmmap_clients.streams import is_endpoint

__all__ = ["open_scans"]


def open_scans(source: str, poses: str | None, stack: ExitStack, reader: ScanReader) -> Iterable[Scan]:
    """Return the scans of a directory, or those of a publisher as they come.

    Parameters
    ----------
    source
        Directory or address.
    poses
        File with T_map_sensor of each scan of a directory; the first and the last pair are said.
    stack
        Closes a subscription.
    reader
        How files are read, and which points of files and messages count.

    Raises
    ------
    BadRequest
        A file of poses for scans of a publisher, which bring their own; or the address makes no sense.
    MapMissing, MapDataError
        The directory or the file cannot be read.
    """
    if not is_endpoint(source):
        scans = ScanSequence(source, read_trajectory(poses) if poses else None, reader)
        if scans.pairing:
            reader.say(scans.pairing)
        return scans
    if poses:
        raise BadRequest(f"{poses} is for a directory of scans: those of a publisher bring their poses")
    return _screened(stack.enter_context(ScanSubscriber(source)), reader)


def _screened(scans: Iterable[Scan], reader: ScanReader) -> Iterator[Scan]:
    for scan in scans:
        columns, rows = reader.screened(scan.columns)
        yield scan if rows is None else replace(scan, columns=columns, rows=rows)

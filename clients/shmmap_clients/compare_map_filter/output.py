# SPDX-License-Identifier: Apache-2.0
"""Where filtered scans go: PCD files in a directory, or a ZeroMQ publisher."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from shmmap import write_pcd
from shmmap_clients.compare_map_filter.drive import ComparedScan
from shmmap_clients.scans.scan_sequence import Scan
from shmmap_clients.scans.scan_stream import ScanPublisher
from shmmap_clients.scans.trajectory import quaternion_of
from shmmap_clients.streams import is_endpoint

__all__ = ["Output", "PcdDirectory", "Stream", "open_output"]


class Output(Protocol):
    """Takes scans; `close` ends it."""

    def write(self, compared: ComparedScan) -> None:
        """Take one."""

    def close(self) -> None:
        """No more come."""


def _columns(compared: ComparedScan, mask: bool) -> dict[str, NDArray[Any]]:
    """All points with a column ``kept``, or the kept ones with a column ``index``: their rows in the scan.

    Those rows count the points that were left out before the comparison, too.
    """
    columns, comparison, rows = compared.scan.columns, compared.comparison, compared.scan.rows
    if mask:
        return {**columns, "kept": comparison.kept.astype(np.uint8)}
    index = comparison.indices if rows is None else rows[comparison.indices]
    return {**comparison.select(columns), "index": index.astype(np.uint32)}


class PcdDirectory:
    """Writes ``NAME.pcd`` for each scan, sensor frame, the pose as the file's viewpoint.

    Parameters
    ----------
    directory
        Made if missing; files of the same name are replaced.
    mask
        All points and a column ``kept``, instead of the kept ones and a column ``index``.

    Raises
    ------
    OSError
        The directory cannot be made; later, a file cannot be written.
    """

    def __init__(self, directory: Path, *, mask: bool) -> None:
        directory.mkdir(parents=True, exist_ok=True)
        self._directory = directory
        self._mask = mask

    def write(self, compared: ComparedScan) -> None:
        """Write one file."""
        T = compared.scan.pose
        x, y, z, w = quaternion_of(T[:3, :3])
        viewpoint = (*T[:3, 3].tolist(), w, x, y, z)
        path = self._directory / f"{Path(compared.scan.name).name}.pcd"
        write_pcd(path, _columns(compared, self._mask), viewpoint=viewpoint)

    def close(self) -> None:
        """Nothing to do: every file is complete."""


class Stream:
    """Publishes each scan; see `shmmap_clients.scans.scan_stream`.

    Parameters
    ----------
    endpoint
        Address to bind.
    mask
        As in `PcdDirectory`.
    wait_s
        How long to wait for the first listener.
    """

    def __init__(self, endpoint: str, *, mask: bool, wait_s: float) -> None:
        self._publisher = ScanPublisher(endpoint)
        self._mask = mask
        self._publisher.wait_for_listener(wait_s)

    def write(self, compared: ComparedScan) -> None:
        """Send one scan."""
        scan = compared.scan
        columns = _columns(compared, self._mask)
        no_map = compared.comparison.no_map
        self._publisher.send(Scan(scan.name, scan.stamp_s, columns, scan.T_map_sensor, no_map))

    def close(self) -> None:
        """Say that it was the last one."""
        self._publisher.send(None)
        self._publisher.close()


def open_output(target: str, *, mask: bool, wait_s: float) -> Output:
    """Return the output for a directory or an endpoint."""
    if is_endpoint(target):
        return Stream(target, mask=mask, wait_s=wait_s)
    return PcdDirectory(Path(target), mask=mask)

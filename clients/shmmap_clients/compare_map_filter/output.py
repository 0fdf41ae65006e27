# SPDX-License-Identifier: Apache-2.0
"""Outputs of filtered scans: PCD files in a directory, a ZeroMQ publisher, and a picture from above."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from shmmap import write_pcd
from shmmap.formats.svg import Axes, Page, dash, swatch
from shmmap_clients.compare_map_filter.drive import ComparedScan
from shmmap_clients.scans.scan_sequence import Scan
from shmmap_clients.scans.scan_stream import ScanPublisher
from shmmap_clients.scans.trajectory import quaternion_of
from shmmap_clients.spread import Decimated
from shmmap_clients.streams import is_endpoint

_SIDE_PX: Final = 1200.0  # longest side of the picture
_MARGIN: Final = 2.0  # metres
_REMOVED: Final = (178, 186, 194, 255)
_KEPT: Final = (214, 40, 40, 255)
_DRIVE: Final = "#1c7ed6"
_MOST: Final = 1 << 20  # pixels kept before their side is doubled
_OFFSET: Final = 1 << 30  # makes indices positive, so that two fit into one int64


class Output(Protocol):
    """Receiver of scans, until `close`."""

    def write(self, compared: ComparedScan) -> None:
        """Write a scan."""

    def close(self) -> None:
        """Finish after the last scan."""


def _columns(compared: ComparedScan, mask: bool) -> dict[str, NDArray[Any]]:
    """Return all points with a column ``kept``, or the kept points with a column ``index``.

    The index is the row in the original scan, including points left out before the comparison.
    """
    columns, comparison, rows = compared.scan.columns, compared.comparison, compared.scan.rows
    if mask:
        return {**columns, "kept": comparison.kept.astype(np.uint8)}
    index = comparison.indices if rows is None else rows[comparison.indices]
    return {**comparison.select(columns), "index": index.astype(np.uint32)}


class PcdDirectory:
    """Writer of ``NAME.pcd`` for each scan, sensor frame, with the pose as the file's viewpoint.

    Parameters
    ----------
    directory
        Directory, created if missing; files of the same name are replaced.
    mask
        Whether to write all points with a column ``kept``, not only the kept ones with a column ``index``.

    Raises
    ------
    OSError
        The directory cannot be created; later, a file cannot be written.
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
        """Do nothing: every file is complete."""


class Stream:
    """Publisher of each scan; see `shmmap_clients.scans.scan_stream`.

    Parameters
    ----------
    endpoint
        Address to bind.
    mask
        As in `PcdDirectory`.
    wait_s
        Timeout of the wait for the first subscriber, seconds.
    """

    def __init__(self, endpoint: str, *, mask: bool, wait_s: float) -> None:
        self._publisher = ScanPublisher(endpoint)
        self._mask = mask
        self._publisher.wait_for_subscriber(wait_s)

    def write(self, compared: ComparedScan) -> None:
        """Send one scan."""
        scan = compared.scan
        columns = _columns(compared, self._mask)
        no_map = compared.comparison.no_map
        self._publisher.send(Scan(scan.name, scan.stamp_s, columns, scan.T_map_sensor, no_map))

    def close(self) -> None:
        """Publish the end of the stream."""
        self._publisher.send(None)
        self._publisher.close()


def open_output(target: str, *, mask: bool, wait_s: float) -> Output:
    """Return the output for a directory or an endpoint."""
    if is_endpoint(target):
        return Stream(target, mask=mask, wait_s=wait_s)
    return PcdDirectory(Path(target), mask=mask)


class TopView:
    """Picture of the ground pixels with kept and with removed points.

    Parameters
    ----------
    pixel
        Side of a pixel, metres; it is doubled when the picture becomes too large.
    """

    def __init__(self, pixel: float = 0.1) -> None:
        self._pixel = pixel
        self._offset = _OFFSET
        self._kept = np.empty(0, np.int64)
        self._removed = np.empty(0, np.int64)
        self._path: Decimated[tuple[float, float]] = Decimated()

    def add(self, xyz: NDArray[Any], kept: NDArray[np.bool_], position: tuple[float, float]) -> None:
        """Add a scan: (N, 3) and (N,), metres, map frame; and its position."""
        places = np.floor(xyz[:, :2].astype(np.float64) / self._pixel)
        finite = np.isfinite(places).all(axis=1) & (np.abs(places) < self._offset).all(axis=1)
        index = places[finite].astype(np.int64) + self._offset
        packed = (index[:, 1] << 32) | index[:, 0]
        mine = kept[finite]
        self._kept = np.union1d(self._kept, packed[mine])
        self._removed = np.union1d(self._removed, packed[~mine])
        self._path.add(position)
        while len(self._kept) + len(self._removed) > _MOST:
            self._coarsen()

    def _coarsen(self) -> None:
        """Double the side of pixels, so that memory does not grow with the length of the drive."""
        self._pixel *= 2
        self._offset //= 2
        self._kept, self._removed = (
            np.unique(((packed >> 33) << 32) | ((packed & 0xFFFFFFFF) >> 1))
            for packed in (self._kept, self._removed)
        )

    def svg(self, title: str, note: str) -> str:
        """Return the picture, north up, with two lines of text, a legend and a scale below."""
        removed, kept = (_unpacked(packed) - self._offset for packed in (self._removed, self._kept))
        path = np.array(self._path.values).reshape(-1, 2)
        corners = np.concatenate([removed * self._pixel, kept * self._pixel, path])
        if not len(corners):
            corners = np.zeros((1, 2))
        low, high = corners.min(axis=0) - _MARGIN, corners.max(axis=0) + self._pixel + _MARGIN
        page = Page(_SIDE_PX, title)
        axes = Axes.fitted(page, (*low.tolist(), *high.tolist()), page.margin, _SIDE_PX)
        axes.raster([(removed, _REMOVED), (kept, _KEPT)], self._pixel)
        axes.line(self._path.values, stroke=_DRIVE, stroke_width=2)
        page.heading(axes.bottom + 28, title, note)
        entries = [
            (swatch(fill=f"rgb{_KEPT[:3]}"), "kept: not in the map"),
            (swatch(fill=f"rgb{_REMOVED[:3]}"), "removed"),
            (dash(stroke=_DRIVE, stroke_width=2), "drive"),
        ]
        return page.svg(axes.legend(axes.bottom + 76, entries) + 16)


def _unpacked(packed: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.stack([packed & 0xFFFFFFFF, packed >> 32], axis=1)

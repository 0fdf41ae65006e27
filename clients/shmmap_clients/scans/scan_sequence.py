# SPDX-License-Identifier: Apache-2.0
"""The scans of a drive in sequence, with poses if known."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest, MapDataError
from shmmap.errors import MapMissing
from shmmap_clients.scans.scan_file import SCAN_SUFFIXES, ScanReader
from shmmap_clients.scans.scan_names import in_order, pair_with_poses, stem
from shmmap_clients.scans.trajectory import Trajectory

_PERIOD_S: Final = 0.1  # period of scans without a time, as of most LiDARs


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """A scan.

    Attributes
    ----------
    name
        The file's name without its suffix, or the sender's name of the scan.
    stamp_s
        Time, seconds.
    columns
        ``xyz`` (N, 3) float32 or float64, sensor frame, metres, and other columns with as many rows.
    T_map_sensor
        (4, 4) float64; None if unknown.
    no_map
        Whether the points were filtered with a map, but the map had no cells around them.
    rows
        (N,) int64: rows of the points in the file or message, if others were left out; else None.
    """

    name: str
    stamp_s: float
    columns: dict[str, NDArray[Any]] = field(repr=False)
    T_map_sensor: NDArray[np.float64] | None = None
    no_map: bool = False
    rows: NDArray[np.int64] | None = field(default=None, repr=False)

    @property
    def xyz(self) -> NDArray[Any]:
        """Points, (N, 3), sensor frame, metres."""
        return self.columns["xyz"]

    @property
    def pose(self) -> NDArray[np.float64]:
        """Pose of the scan, ``T_map_sensor``.

        Raises
        ------
        BadRequest
            The pose is unknown.
        """
        if self.T_map_sensor is None:
            raise BadRequest(f"scan {self.name} has no pose", hint="give poses with --poses FILE")
        return self.T_map_sensor


class ScanSequence:
    """The scans in a directory (PCD, NPZ or ``.bin``), by name, ``s_9`` before ``s_10``.

    Each file is read when the iteration reaches it.  `pair_with_poses` defines the pose of each scan, and
    the order of scans with poses.

    Parameters
    ----------
    directory
        Directory of the scans.
    trajectory
        Poses of the scans; None: no poses, and times 0.1 s apart.
    reader
        Reader of files, which also filters points; by default it keeps all finite points.

    Attributes
    ----------
    files
        Files in the order of the iteration.
    pairing
        Description of the pairing with poses: method, first and last pair; empty without poses.

    Raises
    ------
    MapMissing
        There is no such directory, or no scan in it.
    BadRequest
        The names have no order, or the poses do not fit the scans.
    """

    def __init__(
        self,
        directory: str | os.PathLike[str],
        trajectory: Trajectory | None = None,
        reader: ScanReader | None = None,
    ) -> None:
        try:
            found = [path for path in Path(directory).iterdir() if path.suffix.lower() in SCAN_SUFFIXES]
        except (FileNotFoundError, NotADirectoryError):
            raise MapMissing(f"{os.fspath(directory)} is no directory") from None
        except OSError as error:
            raise MapDataError(f"{os.fspath(directory)}: cannot be read: {error.strerror}") from error
        if not found:
            raise MapMissing(
                f"{os.fspath(directory)} has no scans",
                hint=f"names end in {', '.join(SCAN_SUFFIXES)}; those in a bag in .db3, .mcap",
            )
        self.files = in_order(found)
        self.reader = reader if reader is not None else ScanReader(min_range=0.0)
        self.pairing = ""
        self._trajectory = trajectory
        self._rows = list(range(len(self.files)))
        if trajectory is not None:
            rows, how = pair_with_poses(self.files, trajectory)
            order = sorted(range(len(rows)), key=rows.__getitem__) if how != "place" else range(len(rows))
            self.files, self._rows = [self.files[n] for n in order], [rows[n] for n in order]
            first, last = (self._pair(n) for n in (0, -1))
            self.pairing = f"{len(rows)} scans have poses by {how}: {first}, ..., {last}"

    def __len__(self) -> int:
        return len(self.files)

    def leave_out(self, count: int) -> None:
        """Skip the first ``count`` scans."""
        del self.files[:count], self._rows[:count]

    def __iter__(self) -> Iterator[Scan]:
        for path, row in zip(self.files, self._rows, strict=True):
            columns, kept = self.reader.screened(self.reader.read(path))
            stamp_s, T = row * _PERIOD_S, None
            if self._trajectory is not None:
                stamp_s, T = float(self._trajectory.stamps_s[row]), self._trajectory.T_map_sensor[row]
            yield Scan(stem(path), stamp_s, columns, T, rows=kept)

    def _pair(self, number: int) -> str:
        assert self._trajectory is not None  # noqa: S101  # asked only then
        row = self._rows[number]
        return f"{stem(self.files[number])} pose {row} at {self._trajectory.stamps_s[row]:.12g} s"

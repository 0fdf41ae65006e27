# SPDX-License-Identifier: Apache-2.0
"""The scans of a drive, one after the other, with their poses where these are known."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest, MapDataError, MapMissing
from shmmap_clients.scans.scan_file import SCAN_SUFFIXES, read_scan_fields
from shmmap_clients.scans.trajectory import Trajectory

__all__ = ["Scan", "ScanSequence"]

_PERIOD_S: Final = 0.1  # between scans without a time: that of most LiDARs


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """One scan.

    Attributes
    ----------
    name
        For people: the file's name without its suffix, or what the sender calls it.
    stamp_s
        Seconds.
    columns
        ``xyz`` (N, 3) float32 or float64, sensor frame, metres; other columns of as many rows.
    T_map_sensor
        (4, 4) float64; None where it is not known.
    no_map
        Its points were filtered with a map, but there was none around it.
    """

    name: str
    stamp_s: float
    columns: dict[str, NDArray[Any]] = field(repr=False)
    T_map_sensor: NDArray[np.float64] | None = None
    no_map: bool = False

    @property
    def xyz(self) -> NDArray[Any]:
        """Points, (N, 3), sensor frame, metres."""
        return self.columns["xyz"]


class ScanSequence:
    """The scans in a directory (PCD, NPZ or KITTI ``.bin``), by name, ``s_9`` before ``s_10``; read when
    their turn comes.

    A scan gets its pose by its place, where there are as many poses as scans; else by the last number in
    its name, which counts the poses from 0 (``scan_0081.npz`` gets the 82nd).

    Parameters
    ----------
    directory
        Of the scans.
    trajectory
        Their poses; None: scans have none, and times 0.1 s apart.

    Raises
    ------
    MapMissing
        There is no such directory, or no scan in it.
    BadRequest
        The poses do not fit the scans.
    """

    def __init__(self, directory: str | os.PathLike[str], trajectory: Trajectory | None = None) -> None:
        try:
            found = [path for path in Path(directory).iterdir() if path.suffix.lower() in SCAN_SUFFIXES]
            self.files = sorted(found, key=_by_numbers)
        except (FileNotFoundError, NotADirectoryError):
            raise MapMissing(f"{os.fspath(directory)} is no directory") from None
        except OSError as error:
            raise MapDataError(f"{os.fspath(directory)}: cannot be read: {error.strerror}") from error
        if not self.files:
            raise MapMissing(
                f"{os.fspath(directory)} has no scans", hint=f"names end in {', '.join(SCAN_SUFFIXES)}"
            )
        self._trajectory = trajectory
        self._rows = list(range(len(self.files)))
        if trajectory is not None and len(trajectory) != len(self.files):
            self._rows = [_row(path, len(trajectory), len(self.files)) for path in self.files]

    def __len__(self) -> int:
        return len(self.files)

    def leave_out(self, count: int) -> None:
        """Begin after so many scans."""
        del self.files[:count], self._rows[:count]

    def __iter__(self) -> Iterator[Scan]:
        for path, row in zip(self.files, self._rows, strict=True):
            columns = read_scan_fields(path)
            if self._trajectory is None:
                yield Scan(path.stem, row * _PERIOD_S, columns)
            else:
                stamp_s = float(self._trajectory.stamps_s[row])
                yield Scan(path.stem, stamp_s, columns, self._trajectory.T_map_sensor[row])


def _by_numbers(path: Path) -> tuple[list[str | int], str]:
    """Key for sorting by name, numbers in it by their value: not all programs write leading zeros."""
    words = re.split(r"([0-9]+)", path.name)
    return [int(word) if place % 2 else word for place, word in enumerate(words)], path.name


def _row(path: Path, poses: int, scans: int) -> int:
    numbers = re.findall(r"\d+", path.stem)
    if not numbers or int(numbers[-1]) >= poses:
        raise BadRequest(
            f"{poses} poses do not fit {scans} scans: {path.name} has no number of one of them in its name",
            hint="give a pose for each scan, or number the scans by the poses' lines, from 0",
        )
    return int(numbers[-1])

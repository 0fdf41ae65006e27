# SPDX-License-Identifier: Apache-2.0
"""Reading one scan from a file: PCD, NPZ, bare rows (``.bin``), any cloud that shmmap reads; thinning."""

from __future__ import annotations

import os
import stat
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap import MapDataError, read_cloud
from shmmap.errors import MapMissing
from shmmap.layers import build_layer
from shmmap_clients.scans.bin_layout import BinLayout, guess_layout

SCAN_SUFFIXES: Final = (".pcd", ".npz", ".bin")
MIN_RANGE_M: Final = 0.5
"""Default range below which points are left out: no-returns at (0, 0, 0) and parts of the vehicle."""
_NO_ARCHIVE: Final = (
    ValueError,
    KeyError,
    EOFError,
    MemoryError,
    RuntimeError,
    zipfile.BadZipFile,
    zlib.error,
)
_METRES: Final = {"xyz": 1.0, "xyz_4mm": 0.004}
Columns = dict[str, NDArray[Any]]


def _silent(note: str) -> None:
    """Do nothing."""


@dataclass(slots=True)
class ScanReader:
    """Reader of all scans of a program, with the same settings.

    Attributes
    ----------
    bin_layout
        Columns of ``.bin`` files; None: guessed from the first non-empty file, and reported.
    min_range
        Range in metres below which `screened` leaves out points; None: it keeps all points, even those not
        finite.
    say
        Called once with each note about the format of files.
    too_near, not_finite
        Number of points that `screened` has left out.
    """

    bin_layout: BinLayout | None = None
    min_range: float | None = MIN_RANGE_M
    say: Callable[[str], None] = field(default=_silent, repr=False)
    too_near: int = 0
    not_finite: int = 0

    @property
    def counts(self) -> dict[str, int]:
        """Number of points left out so far, by their names in JSON."""
        return {"too_near": self.too_near, "not_finite": self.not_finite}

    @property
    def left_out(self) -> str:
        """Description of the points left out; empty if there are none."""
        near = f"{self.too_near} points nearer than {self.min_range:g} m" if self.too_near else ""
        return ", ".join(filter(None, [near, f"{self.not_finite} not finite" if self.not_finite else ""]))

    def read(self, path: str | os.PathLike[str]) -> Columns:
        """Return all columns and rows of a file, by name, including ``xyz`` (N, 3), metres.

        An NPZ holds ``xyz`` in metres or ``xyz_4mm`` in units of 4 mm, and any arrays with the same number of
        rows.

        Raises
        ------
        MapMissing
            There is no such file.
        MapDataError
            The contents do not fit the suffix, or the path is a pipe or a directory.
        """
        name = os.fspath(path)
        suffix = os.path.splitext(name)[1].lower()
        try:
            mode = os.stat(name).st_mode
            if not stat.S_ISREG(mode):
                kind = "a directory" if stat.S_ISDIR(mode) else "a pipe or a device"
                raise MapDataError(f"{name}: cannot be read: {kind}, not a file")
            if suffix == ".npz":
                return _from_npz(name)
            if suffix == ".bin":
                return self._from_bin(name)
        except (FileNotFoundError, NotADirectoryError):
            raise MapMissing(f"there is no file {name}") from None
        except OSError as error:
            raise MapDataError(f"{name}: cannot be read: {error.strerror}") from error
        return dict(read_cloud(name, keep_non_finite=True).columns)

    def points(self, path: str | os.PathLike[str]) -> NDArray[np.floating]:
        """Return the screened points of a file, (N, 3); see `read` and `screened`."""
        return self.screened(self.read(path))[0]["xyz"]

    def screened(self, columns: Columns) -> tuple[Columns, NDArray[np.int64] | None]:
        """Remove and count points that are not finite or nearer than `min_range`.

        Returns
        -------
        The columns, and the numbers of their rows; None for all rows.
        """
        if self.min_range is None:
            return columns, None
        xyz = columns["xyz"]
        finite = np.asarray(np.isfinite(xyz).all(axis=1))
        with np.errstate(over="ignore", invalid="ignore"):
            # comparisons with NaN are false, so that NaN is not near
            near = np.einsum("ij,ij->i", xyz, xyz, dtype=np.float64, casting="unsafe") < self.min_range**2
        good = finite & ~near
        if good.all():
            return columns, None
        self.not_finite += len(finite) - int(np.count_nonzero(finite))
        self.too_near += int(np.count_nonzero(finite & near))
        return {name: values[good] for name, values in columns.items()}, np.flatnonzero(good)

    def _from_bin(self, name: str) -> Columns:
        if self.bin_layout is None:
            self.bin_layout = guess_layout(name)
            if self.bin_layout is None:
                return {"xyz": np.empty((0, 3), np.float32)}
            self.say(f"{name}: {self.bin_layout}, by the look of its numbers; --bin-columns names others")
        return self.bin_layout.read(name)


def read_scan(path: str | os.PathLike[str]) -> NDArray[np.floating]:
    """Return the finite points of a scan, (N, 3) float32 or float64 as in the file, sensor frame, metres.

    Raises
    ------
    MapMissing
        There is no such file.
    MapDataError
        The contents do not fit the suffix.
    """
    return ScanReader(min_range=0.0).points(path)


def _from_npz(name: str) -> Columns:
    try:
        with zipfile.ZipFile(name), np.load(name, allow_pickle=False) as archive:
            arrays = {key: archive[key] for key in archive.files}
    except _NO_ARCHIVE as error:
        raise MapDataError(f"{name}: not an NPZ archive of plain arrays: {error}") from None
    for key, metres in _METRES.items():
        if key in arrays:
            raw = arrays.pop(key)
            if raw.ndim != 2 or raw.shape[1] != 3 or raw.dtype.kind not in "fiu":
                raise MapDataError(f"{name}: {key} must have shape (N, 3), it has {raw.shape}")
            scaled = raw if metres == 1.0 and raw.dtype.kind == "f" else raw.astype(np.float32)
            xyz = scaled if metres == 1.0 else scaled * np.float32(metres)
            others = {k: v for k, v in arrays.items() if v.ndim and len(v) == len(xyz)}
            return {"xyz": xyz, **others}
    raise MapDataError(f"{name}: no array called xyz or xyz_4mm", hint="save it with np.savez(file, xyz=...)")


def thinned(points: NDArray[np.floating], edge: float | None) -> NDArray[np.floating]:
    """Return the mean of the points in each cube of ``edge`` metres; without an edge, the points.

    Parameters
    ----------
    points : (N, 3)
        Points, metres.
    edge
        Edge of the cubes, metres; None: all points.

    Raises
    ------
    BadRequest
        The edge is invalid.
    """
    if edge is None or not len(points):
        return points
    columns = build_layer(f"voxel(leaf={edge!r})", points).columns
    return np.asarray(columns["xyz"], points.dtype)

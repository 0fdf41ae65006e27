# SPDX-License-Identifier: Apache-2.0
"""One scan from one file: PCD, NPZ, or KITTI's ``.bin``; or from any cloud file that shmmap reads."""

from __future__ import annotations

import os
import zipfile
import zlib
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap import MapDataError, MapMissing, read_cloud

__all__ = ["SCAN_SUFFIXES", "read_scan", "read_scan_fields"]

SCAN_SUFFIXES: Final = (".pcd", ".npz", ".bin")
_NO_ARCHIVE: Final = (
    ValueError, KeyError, EOFError, MemoryError, RuntimeError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
_METRES: Final = {"xyz": 1.0, "xyz_4mm": 0.004}


def read_scan(path: str | os.PathLike[str]) -> NDArray[np.floating]:
    """Return the points of a scan, (N, 3) float32 (float64 where the file has it), sensor frame, metres.

    Raises
    ------
    MapMissing
        There is no such file.
    MapDataError
        The file is not what its name says.
    """
    return read_scan_fields(path)["xyz"]


def read_scan_fields(path: str | os.PathLike[str]) -> dict[str, NDArray[Any]]:
    """Return all columns of a scan by name, ``xyz`` (N, 3) among them; rows that are not finite left out.

    An NPZ holds ``xyz`` in metres or ``xyz_4mm`` in units of 4 mm, and any arrays of as many rows.  A
    KITTI ``.bin`` is rows of four float32, x y z and intensity.
    """
    name = os.fspath(path)
    suffix = os.path.splitext(name)[1].lower()
    if not os.path.exists(name):
        raise MapMissing(f"there is no file {name}")
    try:
        if suffix == ".npz":
            return _finite(_from_npz(name))
        if suffix == ".bin":
            return _finite(_from_bin(name))
    except OSError as error:
        raise MapDataError(f"{name}: cannot be read: {error.strerror}") from error
    return dict(read_cloud(name).columns)


def _from_npz(name: str) -> dict[str, NDArray[Any]]:
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


def _from_bin(name: str) -> dict[str, NDArray[Any]]:
    raw = np.fromfile(name, np.float32)
    if os.path.getsize(name) % 16:
        raise MapDataError(f"{name}: its size is not a multiple of 16 bytes: not rows of x y z intensity")
    rows = raw.reshape(-1, 4)
    return {"xyz": np.ascontiguousarray(rows[:, :3]), "intensity": rows[:, 3].copy()}


def _finite(columns: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    good = np.isfinite(columns["xyz"]).all(axis=1)
    return columns if good.all() else {name: values[good] for name, values in columns.items()}

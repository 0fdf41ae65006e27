# SPDX-License-Identifier: Apache-2.0
"""Whole clouds in memory, from any format that is read; and what a file holds, for `shmmap inspect`."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.columns import ColumnSpec
from shmmap.formats.causes import refusal
from shmmap.formats.degrees import GEOGRAPHIC_SYSTEM, degrees_warning
from shmmap.formats.finite import Bounds
from shmmap.formats.las_reader import LAS_SUFFIXES, LasReader
from shmmap.formats.open3d_reader import OPEN3D_SUFFIXES, read_with_open3d
from shmmap.formats.pcd.header import IDENTITY_VIEWPOINT
from shmmap.formats.pcd.reader import PcdReader
from shmmap.formats.source_file import open_regular

__all__ = ["CLOUD_SUFFIXES", "CloudDescription", "PointCloud", "describe", "read_cloud", "read_pcd"]

CLOUD_SUFFIXES: Final = (".pcd", *LAS_SUFFIXES, *OPEN3D_SUFFIXES)
"""Endings of the files that are read, in lower case."""

_LAS_BLOCK_POINTS: Final = 1 << 20
_NO_WARNINGS: Final[tuple[str, ...]] = ()

Bound = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PointCloud:
    """A cloud in memory.

    Attributes
    ----------
    columns
        ``xyz`` (N, 3) in metres, then every other field as (N,) or (N, k), dtypes as in the file.
    points
        Points in the file; ``dropped`` of them were left out because x, y or z is not finite.
    viewpoint
        Translation x y z in metres, then quaternion w x y z; not applied to the points.
    bounds
        (min_xyz, max_xyz) of the finite points, float64, metres; NaN when there are none.
    warnings
        Oddities of the file.
    """

    columns: dict[str, NDArray[Any]]
    points: int
    dropped: int
    bounds: tuple[Bound, Bound]
    viewpoint: tuple[float, ...] = IDENTITY_VIEWPOINT
    warnings: tuple[str, ...] = ()

    @property
    def xyz(self) -> NDArray[Any]:
        """Coordinates, (N, 3), metres."""
        return self.columns["xyz"]


@dataclass(frozen=True, slots=True)
class CloudDescription:
    """What a file holds, without its points.

    Attributes
    ----------
    path, format, encoding, version, file_bytes
        The file; ``encoding`` and ``version`` are empty where the format has none.
    points, dropped
        Points in the file, and how many of them have an x, y or z that is not finite.
    width, height
        Of an organised cloud; (points, 1) otherwise.
    columns
        As `PointCloud.columns` would have them.
    bounds, viewpoint, warnings
        As in `PointCloud`.
    digest
        XXH3-128 of a PCD file's bytes; empty for other formats.
    """

    path: str
    format: str
    encoding: str
    version: str
    file_bytes: int
    points: int
    dropped: int
    width: int
    height: int
    columns: tuple[ColumnSpec, ...]
    bounds: tuple[Bound, Bound]
    viewpoint: tuple[float, ...] = IDENTITY_VIEWPOINT
    warnings: tuple[str, ...] = ()
    digest: bytes = field(default=b"", repr=False)


def read_pcd(path: str | os.PathLike[str], *, keep_non_finite: bool = False) -> PointCloud:
    """Read a whole PCD file.

    Raises
    ------
    MapDataError
        If the file is not what it claims to be; causes in `shmmap.formats.causes`.
    """
    with PcdReader(path, keep_non_finite=keep_non_finite) as reader:
        parts = [tuple(column.copy() for column in block) for block in reader.blocks()]
        columns = {
            spec.name: np.concatenate(
                [np.empty(_shape(spec), spec.dtype), *(part[index] for part in parts)], dtype=spec.dtype
            )
            for index, spec in enumerate(reader.columns)
        }
        return PointCloud(
            columns=columns,
            points=reader.header.points,
            dropped=reader.dropped,
            bounds=reader.bounds,
            viewpoint=reader.header.viewpoint,
            warnings=reader.warnings,
        )


def read_cloud(path: str | os.PathLike[str], *, keep_non_finite: bool = False) -> PointCloud:
    """Read a whole cloud: PCD by our own reader, LAS and LAZ through laspy, the rest through Open3D.

    Raises
    ------
    MapDataError
        If the file cannot be read, or its format is not supported.
    """
    suffix = _suffix(path)
    if suffix == ".pcd":
        return read_pcd(path, keep_non_finite=keep_non_finite)
    if suffix in LAS_SUFFIXES:
        columns, warnings = _read_las(path), _NO_WARNINGS
    else:
        columns, warnings = read_with_open3d(os.fspath(path), suffix)
    points = len(columns["xyz"])
    bounds = Bounds()
    mask = bounds.add(np.ascontiguousarray(columns["xyz"]))
    if mask is not None and not keep_non_finite:
        columns = {name: values[mask] for name, values in columns.items()}
    return PointCloud(
        columns=columns,
        points=points,
        dropped=points - len(columns["xyz"]),
        bounds=bounds.result(),
        warnings=warnings,
    )


def describe(path: str | os.PathLike[str]) -> CloudDescription:
    """Read a file to its end and say what it holds; PCD, LAS and LAZ in bounded memory.

    Raises
    ------
    MapDataError
        As `read_cloud`.
    """
    found = _described(path)
    if GEOGRAPHIC_SYSTEM not in found.warnings and (warning := degrees_warning(*found.bounds)):
        found = replace(found, warnings=(*found.warnings, warning))
    return found


def _described(path: str | os.PathLike[str]) -> CloudDescription:
    suffix = _suffix(path)
    if suffix in LAS_SUFFIXES:
        return _describe_las(path, suffix)
    if suffix != ".pcd":
        cloud = read_cloud(path)
        specs = tuple(
            ColumnSpec(
                name, values.dtype, 1 if values.ndim == 1 else values.shape[1], "m" if name == "xyz" else ""
            )
            for name, values in cloud.columns.items()
        )
        return CloudDescription(
            path=os.fspath(path),
            format=suffix[1:],
            encoding="",
            version="",
            file_bytes=os.stat(path).st_size,
            points=cloud.points,
            dropped=cloud.dropped,
            width=cloud.points,
            height=1,
            columns=specs,
            bounds=cloud.bounds,
            warnings=cloud.warnings,
        )
    with PcdReader(path) as reader:
        for _ in reader.blocks():
            pass
        header = reader.header
        return CloudDescription(
            path=reader.path,
            format="pcd",
            encoding=header.encoding,
            version=header.version,
            file_bytes=os.fstat(reader.fileno()).st_size,
            points=header.points,
            dropped=reader.dropped,
            width=header.width,
            height=header.height,
            columns=reader.columns,
            bounds=reader.bounds,
            viewpoint=header.viewpoint,
            warnings=reader.warnings,
            digest=reader.digest,
        )


def _describe_las(path: str | os.PathLike[str], suffix: str) -> CloudDescription:
    bounds, dropped = Bounds(), 0
    with LasReader(path) as reader:
        for block in reader.blocks(_LAS_BLOCK_POINTS):
            mask = bounds.add(block["xyz"])
            dropped += 0 if mask is None else int(np.count_nonzero(~mask))
        return CloudDescription(
            path=reader.path,
            format=suffix[1:],
            encoding="",
            version=reader.version,
            file_bytes=os.stat(path).st_size,
            points=reader.points,
            dropped=dropped,
            width=reader.points,
            height=1,
            columns=reader.columns,
            bounds=bounds.result(),
            warnings=reader.warnings,
        )


def _read_las(path: str | os.PathLike[str]) -> dict[str, NDArray[Any]]:
    with LasReader(path) as reader:
        blocks = list(reader.blocks(_LAS_BLOCK_POINTS))
        return {
            spec.name: np.concatenate([np.empty(_shape(spec), spec.dtype), *(b[spec.name] for b in blocks)])
            for spec in reader.columns
        }


def _suffix(path: str | os.PathLike[str]) -> str:
    name = os.fspath(path)
    suffix = os.path.splitext(name)[1].lower()
    if suffix not in CLOUD_SUFFIXES:
        os.close(open_regular(name))  # what is not there, or no file, is refused for that
        raise refusal(
            "unsupported_format",
            f"files called {suffix or 'without a suffix'} are not read",
            path=name,
            hint=f"readable are {', '.join(CLOUD_SUFFIXES)}; convert it to one of them",
        )
    return suffix


def _shape(spec: ColumnSpec) -> tuple[int, ...]:
    return (0,) if spec.components == 1 else (0, spec.components)

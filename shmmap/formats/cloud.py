# SPDX-License-Identifier: Apache-2.0
"""Read clouds of any supported format: block by block, whole into memory, or only to describe them."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from shmmap.columns import Bounds, ColumnSpec
from shmmap.formats.coordinate_system import (
    GEOGRAPHIC_SYSTEM,
    CoordinateSystem,
    degrees_warning,
    unit_warnings,
)
from shmmap.formats.las_reader import LAS_SUFFIXES, LasReader
from shmmap.formats.pcd.header import IDENTITY_VIEWPOINT
from shmmap.formats.pcd.reader import PcdReader
from shmmap.formats.ply_reader import PlyReader
from shmmap.formats.point_checks import step_warning
from shmmap.formats.source_file import open_regular, refusal
from shmmap.formats.text_reader import TABLE_SUFFIXES, TEXT_SUFFIXES, TextReader

CLOUD_SUFFIXES: Final = (".pcd", *LAS_SUFFIXES, ".ply", *TEXT_SUFFIXES)
"""File endings, in lower case, that count as clouds in a directory."""

READABLE_SUFFIXES: Final = (*CLOUD_SUFFIXES, *TABLE_SUFFIXES)
"""File endings, in lower case, that are read if the file is named."""


BlockReader: TypeAlias = LasReader | PlyReader | TextReader
"""A cloud of a format other than PCD, opened and its header checked."""


def cloud_suffix(path: str | os.PathLike[str]) -> str:
    """Return the ending of a cloud's file in lower case, one of `READABLE_SUFFIXES`.

    Raises
    ------
    MapDataError
        ``unsupported_format``; or ``missing`` and similar causes if there is no such regular file.
    """
    name = os.fspath(path)
    suffix = os.path.splitext(name)[1].lower()
    if suffix not in READABLE_SUFFIXES:
        os.close(open_regular(name))
        raise refusal(
            "unsupported_format",
            f"files that end in {suffix} are not read" if suffix else "files without a suffix are not read",
            path=name,
            hint=f"readable are {', '.join(READABLE_SUFFIXES)}; convert it to one of them",
        )
    return suffix


def open_blocks(path: str, suffix: str, *, drop_noise: bool = False) -> BlockReader:
    """Open a cloud of a format other than PCD; errors are those of its reader."""
    if suffix in LAS_SUFFIXES:
        return LasReader(path, drop_noise=drop_noise)
    return PlyReader(path) if suffix == ".ply" else TextReader(path)


_BLOCK_POINTS: Final = 1 << 18

Bound = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PointCloud:
    """A cloud in memory.

    Attributes
    ----------
    columns
        ``xyz`` (N, 3) in metres, then every other field as (N,) or (N, k), dtypes as in the file.
    points
        Points in the file; ``dropped`` of them were left out because x, y or z is not finite, or because LAS
        marks them.
    viewpoint
        Translation x y z in metres, then quaternion w x y z; not applied to the points.
    bounds
        (min_xyz, max_xyz) of the finite points, float64, metres; NaN if no point is finite.
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
    """The contents of a cloud file, without its points.

    Attributes
    ----------
    path, format, encoding, version, file_bytes
        The file; ``encoding`` and ``version`` are empty if the format has none.
    points, dropped
        Points in the file, and how many of them are left out: x, y or z is not finite, or LAS flags them
        withheld.
    width, height
        Size of an organised cloud; (points, 1) otherwise.
    columns
        Columns as in `PointCloud.columns`.
    bounds, viewpoint, warnings
        As in `PointCloud`.
    crs
        The coordinate system that the file names; None if it names none.
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
    crs: CoordinateSystem | None = None
    digest: bytes = field(default=b"", repr=False)


def read_pcd(path: str | os.PathLike[str], *, keep_non_finite: bool = False) -> PointCloud:
    """Read a whole PCD file.

    Raises
    ------
    MapDataError
        The file contradicts its header or format; causes in `shmmap.formats.source_file`.
    """
    with PcdReader(path, keep_non_finite=keep_non_finite) as reader:
        parts = [tuple(column.copy() for column in block) for block in reader.blocks()]
        columns = {
            spec.name: np.concatenate(
                [np.empty(_shape(spec, 0), spec.dtype), *(part[index] for part in parts)], dtype=spec.dtype
            )
            for index, spec in enumerate(reader.columns)
        }
        return PointCloud(
            columns=columns,
            points=reader.header.points,
            dropped=reader.dropped,
            bounds=reader.bounds,
            viewpoint=reader.header.viewpoint,
            warnings=_warnings(reader.warnings, reader.header.crs, reader.bounds, reader.columns[0]),
        )


def read_cloud(
    path: str | os.PathLike[str], *, keep_non_finite: bool = False, drop_noise: bool = False
) -> PointCloud:
    """Read a whole cloud of any format: PCD, PLY and text directly, LAS and LAZ through laspy.

    Coordinates are in the file's unit; ``warnings`` names the unit if it is not the metre.

    Parameters
    ----------
    keep_non_finite
        Keep points whose x, y or z is not finite; points that are left out for another reason are NaN then.
    drop_noise
        Leave out points that LAS classifies as noise (classes 7 and 18), as those that are flagged withheld.
        Other formats do not mark noise: it has no effect on them.

    Raises
    ------
    MapDataError
        If the file cannot be read, or its format is not supported.
    """
    suffix = cloud_suffix(path)
    if suffix == ".pcd":
        return read_pcd(path, keep_non_finite=keep_non_finite)
    bounds, kept = Bounds(), 0
    with open_blocks(os.fspath(path), suffix, drop_noise=drop_noise) as reader:
        columns = {spec.name: np.empty(_shape(spec, reader.points), spec.dtype) for spec in reader.columns}
        for block in reader.blocks(_BLOCK_POINTS):
            reader.checks.add(block)
            mask = bounds.add(block["xyz"])
            if mask is not None and not keep_non_finite:
                block = {name: values[mask] for name, values in block.items()}
            rows = slice(kept, kept + len(block["xyz"]))
            for name, values in block.items():
                columns[name][rows] = values
            kept = rows.stop
        return PointCloud(
            columns={name: values[:kept] for name, values in columns.items()},
            points=reader.points,
            dropped=reader.points - kept,
            bounds=bounds.result(),
            warnings=_warnings(
                (*reader.warnings, *reader.checks.notes()), reader.crs, bounds.result(), reader.columns[0]
            ),
        )


def _warnings(
    found: tuple[str, ...], crs: CoordinateSystem | None, bounds: tuple[Bound, Bound], xyz: ColumnSpec
) -> tuple[str, ...]:
    """Return the warnings of a reader, and those that follow from units, bounds and type of coordinates."""
    step = step_warning(*bounds, xyz.dtype, crs.units[0].metres if crs is not None else 1.0)
    return (*found, *unit_warnings(crs), *([step] if step else []))


def describe(path: str | os.PathLike[str]) -> CloudDescription:
    """Read a file to its end, in bounded memory, and describe its contents.

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
    suffix = cloud_suffix(path)
    if suffix != ".pcd":
        return _describe_blocks(os.fspath(path), suffix)
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
            warnings=_warnings(reader.warnings, header.crs, reader.bounds, reader.columns[0]),
            crs=header.crs,
            digest=reader.digest,
        )


def _describe_blocks(path: str, suffix: str) -> CloudDescription:
    bounds, dropped = Bounds(), 0
    with open_blocks(path, suffix) as reader:
        for block in reader.blocks(_BLOCK_POINTS):
            reader.checks.add(block)
            mask = bounds.add(block["xyz"])
            dropped += 0 if mask is None else int(np.count_nonzero(~mask))
        return CloudDescription(
            path=reader.path,
            format=suffix[1:],
            encoding=reader.encoding,
            version=reader.version,
            file_bytes=os.stat(path).st_size,
            points=reader.points,
            dropped=dropped,
            width=reader.points,
            height=1,
            columns=reader.columns,
            bounds=bounds.result(),
            warnings=_warnings(
                (*reader.warnings, *reader.checks.notes()), reader.crs, bounds.result(), reader.columns[0]
            ),
            crs=reader.crs,
        )


def _shape(spec: ColumnSpec, rows: int) -> tuple[int, ...]:
    return (rows,) if spec.components == 1 else (rows, spec.components)

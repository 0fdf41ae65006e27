# SPDX-License-Identifier: Apache-2.0
"""The readers of every format but PCD, as one: opened by the file's ending, read block by block."""

from __future__ import annotations

import os
from collections.abc import Iterator
from types import TracebackType
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from shmmap.columns import ColumnSpec
from shmmap.formats.causes import refusal
from shmmap.formats.coordinate_system import CoordinateSystem
from shmmap.formats.las_reader import LAS_SUFFIXES, LasReader
from shmmap.formats.ply_reader import PlyReader
from shmmap.formats.source_file import open_regular
from shmmap.formats.text_reader import TABLE_SUFFIXES, TEXT_SUFFIXES, TextReader

__all__ = ["CLOUD_SUFFIXES", "READABLE_SUFFIXES", "BlockReader", "cloud_suffix", "open_blocks"]

CLOUD_SUFFIXES: Final = (".pcd", *LAS_SUFFIXES, ".ply", *TEXT_SUFFIXES)
"""Endings of the files in a directory that are clouds, in lower case."""

READABLE_SUFFIXES: Final = (*CLOUD_SUFFIXES, *TABLE_SUFFIXES)
"""Endings of the files that are read where they are named, in lower case."""


class BlockReader(Protocol):
    """A cloud, opened and its header checked.

    Attributes
    ----------
    points
        Points in the file.
    columns
        ``xyz`` first, then every other column.
    bounds
        (min_xyz, max_xyz) where the header says so, float64.
    encoding, version
        Empty where the format has none.
    crs
        What the file says of its coordinate system; None where it says nothing.
    warnings
        Oddities of the file; of its data, once that was read.
    """

    path: str
    points: int
    columns: tuple[ColumnSpec, ...]
    bounds: tuple[NDArray[np.float64], NDArray[np.float64]] | None
    encoding: str
    version: str
    crs: CoordinateSystem | None

    @property
    def warnings(self) -> tuple[str, ...]: ...

    def blocks(self, block_points: int, start: int = 0) -> Iterator[dict[str, NDArray[Any]]]:
        """Yield the columns from point ``start`` on, which may be reused by the next block."""

    def __enter__(self) -> BlockReader: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def close(self) -> None:
        """Close the file."""


def cloud_suffix(path: str | os.PathLike[str]) -> str:
    """Return the ending of a cloud's file in lower case, one of `READABLE_SUFFIXES`.

    Raises
    ------
    MapDataError
        ``unsupported_format``; a file that is not there, or no file, is refused for that.
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


def open_blocks(path: str, suffix: str) -> BlockReader:
    """Open a cloud that is no PCD; errors are those of its reader."""
    if suffix in LAS_SUFFIXES:
        return LasReader(path)
    return PlyReader(path) if suffix == ".ply" else TextReader(path)

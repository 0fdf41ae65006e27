# SPDX-License-Identifier: Apache-2.0
"""One PCD file without metadata as a map of one cell."""

from __future__ import annotations

import os

import numpy as np

from shmmap.errors import MapDataError, MapMissing
from shmmap.formats.degrees import degrees_warning
from shmmap.formats.pcd.reader import PcdReader
from shmmap.origin.catalogue import Catalogue
from shmmap.segment.layout import SourceStamp

__all__ = ["MAX_SINGLE_PCD_BYTES", "is_served_whole", "load_single_pcd"]

MAX_SINGLE_PCD_BYTES = 256 << 20
"""A larger file is refused: loading all of a map to use a part of it is what dividing avoids."""

# What a compressed file of that size may hold; point clouds shrink to a half or a third.
_MAX_POINT_BYTES = 4 * MAX_SINGLE_PCD_BYTES


def is_served_whole(path: str) -> bool:
    """Whether the PCD file at ``path`` is small enough to be one cell; also if it is no sound file."""
    try:
        if os.stat(path).st_size > MAX_SINGLE_PCD_BYTES:
            return False
        with PcdReader(path) as reader:
            return reader.header.points * reader.header.point_bytes <= _MAX_POINT_BYTES
    except (OSError, MapDataError):
        return True  # who loads it says what is wrong


def load_single_pcd(path: str) -> Catalogue:
    """Catalogue of one cell whose box is the bounds of the points in ``path`` (read whole).

    Raises
    ------
    MapMissing
        The file vanished or may not be read.
    MapDataError
        The file is larger than 256 MiB (or its points than 1 GiB), is no sound PCD, or has no finite
        point.
    """
    try:
        status = os.stat(path)
    except OSError as error:
        raise MapMissing(f"cannot read {path}: {error.strerror}") from error
    _refuse_large(path, "file", status.st_size, MAX_SINGLE_PCD_BYTES)
    with PcdReader(path) as reader:
        points_bytes = reader.header.points * reader.header.point_bytes
        _refuse_large(path, "points", points_bytes, _MAX_POINT_BYTES)
        for _ in reader.blocks():
            pass
        lower, upper = reader.bounds
    if not np.isfinite(lower).all():
        raise MapDataError("no finite point, so the map has no extent", path=path, cause="no_points")
    box = (float(lower[0]), float(lower[1]), float(upper[0]), float(upper[1]))
    problems = [f"{path}: {warning}"] if (warning := degrees_warning(lower, upper)) else []
    return Catalogue.from_cells([(path, box, SourceStamp.of(status))], problems=problems)


def _refuse_large(path: str, what: str, size: int, limit: int) -> None:
    if size > limit:
        raise MapDataError(
            f"{size / 2**20:.0f} MiB of {what}; a map of one file without metadata may have {limit >> 20}",
            path=path,
            cause="needs_dividing",
            hint="divide it into cells: shmmap divide",
        )

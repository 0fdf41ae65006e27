# SPDX-License-Identifier: Apache-2.0
"""One PCD file without metadata as a map of one cell."""

from __future__ import annotations

import os

import numpy as np

from shmmap.errors import MapDataError
from shmmap.formats.pcd_reader import PcdReader
from shmmap.origin.catalogue import Catalogue
from shmmap.origin.stamp import Stamp

__all__ = ["MAX_SINGLE_PCD_BYTES", "load_single_pcd"]

MAX_SINGLE_PCD_BYTES = 256 << 20
"""A larger file is refused: loading all of a map to use a part of it is what dividing avoids."""


def load_single_pcd(path: str) -> Catalogue:
    """Catalogue of one cell whose box is the bounds of the points in ``path`` (read whole).

    Raises
    ------
    MapDataError
        The file is larger than 256 MiB, is no sound PCD, or has no finite point.
    """
    status = os.stat(path)
    if status.st_size > MAX_SINGLE_PCD_BYTES:
        raise MapDataError(
            f"{status.st_size / 2**20:.0f} MiB in one file; a map served without metadata"
            f" may have {MAX_SINGLE_PCD_BYTES >> 20} MiB",
            path=path,
            cause="needs_dividing",
            hint="divide it into cells of about 20 m with metadata, as Autoware's pointcloud divider does",
        )
    with PcdReader(path) as reader:
        for _ in reader.blocks():
            pass
        lower, upper = reader.bounds
    if not np.isfinite(lower).all():
        raise MapDataError("no finite point, so the map has no extent", path=path, cause="no_points")
    box = (float(lower[0]), float(lower[1]), float(upper[0]), float(upper[1]))
    return Catalogue.from_cells([(path, box, Stamp.of(status))])

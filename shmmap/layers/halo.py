# SPDX-License-Identifier: Apache-2.0
"""Points of the cells around one, for layers that look into them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shmmap.errors import MapDataError
from shmmap.formats.causes import refusal
from shmmap.layers.contract import Box
from shmmap.layers.source_reader import SourceReader
from shmmap.layers.sources import SMALLER
from shmmap.segment.layout import NO_SOURCE, SourceStamp
from shmmap.segment.source import Source

__all__ = ["Halo", "read_halo"]


@dataclass(slots=True)
class Halo:
    """Points around a cell.

    Attributes
    ----------
    xyz
        (M, 3), of the cell's dtype.
    seen
        Each neighbour's stamp and digest.
    warnings
        Which neighbours have no points here, and why.
    """

    xyz: NDArray[Any]
    seen: tuple[tuple[SourceStamp, bytes], ...]
    warnings: tuple[str, ...]


def read_halo(
    reader: SourceReader, sources: Sequence[Source], box: Box, halo_m: float, dtype: np.dtype[Any]
) -> Halo:
    """Read the neighbours' points within ``halo_m`` of a cell's box, as ``dtype``.

    One that cannot be read has no points, the stamp of before the attempt and a digest of zeros: it must
    not cost its neighbours their layers.

    Raises
    ------
    MapDataError
        If there is not enough memory for a neighbour: another time there may be, so that no layer is
        made without it.
    """
    found: list[NDArray[Any]] = [np.empty((0, 3), dtype)]
    seen: list[tuple[SourceStamp, bytes]] = []
    warnings: list[str] = []
    for neighbour in sources:
        stamp = reader.stamp(neighbour)  # afterwards it may be that of a file that was never read
        before = SourceStamp.from_token(stamp) if stamp is not None else NO_SOURCE
        try:
            source = reader.read(neighbour, box, ("xyz",))
        except MapDataError as error:
            seen.append((before, bytes(16)))
            warnings.append(f"made without a neighbour: {error.message}")
            continue
        except MemoryError as error:
            raise refusal(
                "too_large",
                "this neighbour takes more memory than there is",
                path=neighbour.name,
                hint=SMALLER,
            ) from error
        xyz = source.points.xyz
        x, y = xyz[:, 0], xyz[:, 1]
        inside = (
            (x >= box[0] - halo_m) & (x <= box[2] + halo_m) & (y >= box[1] - halo_m) & (y <= box[3] + halo_m)
        )
        found.append(xyz[inside].astype(dtype))
        seen.append((source.stamp, source.digest))
    return Halo(np.concatenate(found), tuple(seen), tuple(warnings))

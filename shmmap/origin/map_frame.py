# SPDX-License-Identifier: Apache-2.0
"""Where a map's frame lies in the world, as whatever divided it has written down beside the metadata.

`shmmap.dividing` writes the file; other tools' maps have none, and their frame is what it is.
"""

from __future__ import annotations

import json
import math
import os
from typing import Any, Final

import msgspec

from shmmap.errors import MapDataError

__all__ = [
    "REPORT_HEAD",
    "REPORT_NAME",
    "UNKNOWN_FRAME",
    "MapFrame",
    "_frame_of",
    "read_map_frame",
    "read_report",
]

REPORT_NAME: Final = "shmmap_divide.json"
REPORT_HEAD: Final = {"format": "shmmap divided map", "version": 1}
_MAX_BYTES: Final = 64 << 20  # it names each input file


class MapFrame(msgspec.Struct, frozen=True):
    """How to come back from the map frame to the coordinates of the files that the map was made of.

    ``(point + origin) / unit_m`` is the point in the coordinate system ``crs``.

    Attributes
    ----------
    origin
        x, y, z of the map frame's origin in the frame of the inputs, metres, float64: what `divide`
        subtracted from each point.
    crs
        Name of the inputs' coordinate system with its EPSG code where they say, such as
        ``WGS 84 / UTM zone 32N (EPSG:32632)``; empty where they do not.
    unit_m
        Metres per unit of that system, in the plane and in height: (1, 1) unless `divide` converted feet.
    """

    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    crs: str = ""
    unit_m: tuple[float, float] = (1.0, 1.0)


UNKNOWN_FRAME: Final = MapFrame()
"""Of a map beside which nothing is written: the frame is the files' own."""


def _frame_of(report: dict[str, Any]) -> MapFrame:
    """Return the frame that a report speaks of; what it lacks or garbles counts as not said."""
    try:
        frame = msgspec.convert(
            {key: report[key] for key in ("origin", "crs", "unit_m") if key in report}, MapFrame
        )
    except msgspec.ValidationError:
        return UNKNOWN_FRAME
    if not all(map(math.isfinite, (*frame.origin, *frame.unit_m))) or min(frame.unit_m) <= 0:
        return UNKNOWN_FRAME
    return frame


def read_map_frame(directory: str | os.PathLike[str]) -> MapFrame:
    """Return where the frame of the map whose metadata is in ``directory`` lies.

    Never raises: a map without a report, or with one that cannot be read, is a map.
    """
    try:
        report = read_report(directory)
    except MapDataError:
        report = None
    return UNKNOWN_FRAME if report is None else _frame_of(report)


def read_report(map_dir: str | os.PathLike[str]) -> dict[str, Any] | None:
    """Return what `divide` left about a map, or None for a map made by others.

    Raises
    ------
    MapDataError
        It cannot be read, or another version of shmmap has written it.
    """
    path = os.path.join(map_dir, REPORT_NAME)
    try:
        with open(path, "rb") as file:
            data = file.read(_MAX_BYTES + 1)
        report = json.loads(data) if len(data) <= _MAX_BYTES else None
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise MapDataError(f"cannot be read: {error.strerror}", path=path) from error
    except (ValueError, RecursionError) as error:
        raise MapDataError(f"cannot be read: {error}", path=path) from error
    if not isinstance(report, dict) or any(report.get(key) != value for key, value in REPORT_HEAD.items()):
        raise MapDataError("written by another version of shmmap", path=path)
    return report

# SPDX-License-Identifier: Apache-2.0
"""The report beside a divided map, ``shmmap_divide.json``: the map's frame, its inputs, and notes.

`shmmap.dividing` writes it.  Maps of other tools have no report, so their frame is unknown.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from shmmap.errors import MapDataError

REPORT_NAME: Final = "shmmap_divide.json"
REPORT_HEAD: Final = {"format": "shmmap divided map", "version": 1}
_MAX_BYTES: Final = 64 << 20  # the report lists every input file


class MapFrame(msgspec.Struct, frozen=True):
    """Transform from the map frame to the coordinates of the files that the map was made of.

    ``(point + origin) / unit_m`` is the point in the coordinate system ``crs``.

    Attributes
    ----------
    origin
        x, y, z of the map frame's origin in the frame of the inputs, metres, float64: what `divide`
        subtracted from each point.
    crs
        Name of the inputs' coordinate system with its EPSG code, such as
        ``WGS 84 / UTM zone 32N (EPSG:32632)``; empty if the inputs do not give it.
    unit_m
        Metres per unit of that system, in the plane and in height: (1, 1) unless another unit was
        converted.
    """

    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    crs: str = ""
    unit_m: tuple[float, float] = (1.0, 1.0)


_FARTHEST_M: Final = 1e12
UNKNOWN_FRAME: Final = MapFrame()
"""Frame of a map without a report: that of its files."""


def frame_of(report: dict[str, Any]) -> MapFrame:
    """Return the frame that a report describes; missing or malformed values get their defaults."""
    try:
        frame = msgspec.convert(
            {key: report[key] for key in ("origin", "crs", "unit_m") if key in report}, MapFrame
        )
    except msgspec.ValidationError:
        return UNKNOWN_FRAME
    is_sound = all(abs(part) < _FARTHEST_M for part in frame.origin)
    if not (is_sound and all(0 < unit < math.inf for unit in frame.unit_m)):
        return UNKNOWN_FRAME
    return frame


def read_map_frame(directory: str | os.PathLike[str]) -> MapFrame:
    """Return the frame of the map whose metadata is in ``directory``.

    Never raises: a map whose report is missing or unreadable is still served, with an unknown frame.
    """
    try:
        report = read_report(directory)
    except MapDataError:
        report = None
    return UNKNOWN_FRAME if report is None else frame_of(report)


def read_report(map_dir: str | os.PathLike[str]) -> dict[str, Any] | None:
    """Return the report that `divide` wrote beside a map; None for a map of another tool.

    Raises
    ------
    MapDataError
        The report cannot be read, or was written by another version of shmmap.
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


LINK_NAME: Final = "map"
"""Link beside the divisions of a served cloud; it leads to the division in service."""


@dataclass(frozen=True, slots=True)
class DividedMap:
    """Result of a division; also kept in the map as ``shmmap_divide.json``.

    Attributes
    ----------
    path
        The map directory.
    cells, points
        Number of cell files, and of points in them.
    points_read, dropped
        Number of points in the inputs, and of those left out: not finite, or marked so by LAS.
    origin
        Origin of the map frame in the frame of the inputs, metres: adding it to a point of the map gives
        the point of the input.
    crs, unit_m
        The inputs' coordinate system and unit, as in `shmmap.origin.map_report.MapFrame`.
    cell_size, leaf, encoding
        As in `DivideSettings`.
    fields
        Names and dtypes of each point's fields.
    bounds
        Least and greatest coordinates of the points that were divided, in the frame of the map.
    sources
        Path, bytes, mtime_ns and points of each input.
    notes
        Remarks for the user.
    resumed_points
        Points that an earlier, interrupted run had already divided.
    """

    path: str
    cells: int
    points: int
    points_read: int
    dropped: int
    origin: tuple[float, float, float]
    cell_size: float
    leaf: float
    encoding: str
    fields: list[tuple[str, str]]
    bounds: list[list[float]] | None
    sources: list[dict[str, Any]]
    notes: list[str] = field(default_factory=list)
    resumed_points: int = 0
    crs: str = ""
    unit_m: tuple[float, float] = (1.0, 1.0)


def write_report(directory: str | os.PathLike[str], report: DividedMap) -> None:
    """Write ``report`` into a map's directory."""
    content = {**REPORT_HEAD, **asdict(report)}
    text = json.dumps(content, indent=1, allow_nan=False) + "\n"  # ASCII: a path may not be valid Unicode
    Path(directory, REPORT_NAME).write_text(text, encoding="ascii")


_APART_M: Final = 200.0  # cells this far apart, and ten times their size, belong to different groups
_APART_CELLS: Final = 10
_FEW: Final = 3  # a group of more cells, and of more than 1 % of all, is another part of the map
_NAMED: Final = 3


def far_cells_notes(
    corners: NDArray[np.float64], size: float, names: Sequence[str], points: Sequence[int]
) -> list[str]:
    """Name the few cells that lie far from all others, one note for each group of them.

    Parameters
    ----------
    corners
        (N, 2) lower left corners, metres.
    size
        Side of a cell, metres.
    names, points
        File name and number of points of each cell.
    """
    if len(corners) < 2 or not np.isfinite(corners).all():
        return []
    apart = max(_APART_M, _APART_CELLS * size)
    squares: dict[tuple[int, int], list[int]] = {}
    for index, (x, y) in enumerate(np.floor(corners / apart).astype(np.int64).tolist()):
        squares.setdefault((x, y), []).append(index)
    groups = sorted(_groups(squares), key=lambda group: (len(group), sum(points[i] for i in group)))
    main = corners[groups.pop()]
    notes = []
    for group in groups:
        if len(group) > max(_FEW, len(corners) // 100):
            continue
        own = corners[group]
        gaps = np.maximum(own.min(axis=0) - main.max(axis=0), main.min(axis=0) - own.max(axis=0))
        gap = float(np.hypot(*np.maximum(gaps - size, 0.0)))
        if gap >= apart:
            shown = ", ".join(names[i] for i in group[:_NAMED]) + (", ..." if len(group) > _NAMED else "")
            cells = "1 cell lies" if len(group) == 1 else f"{len(group)} cells lie"
            count = sum(points[i] for i in group)
            notes.append(
                f"{cells} {gap / 1000:.3g} km from all others, with {count} point{'' if count == 1 else 's'}"
                f" (stray ones?): {shown}"
            )
    return notes


def _groups(squares: dict[tuple[int, int], list[int]]) -> list[list[int]]:
    """Group the cells whose squares touch."""
    groups: list[list[int]] = []
    left = dict(squares)
    while left:
        group: list[int] = []
        waiting = [next(iter(left))]
        while waiting:
            x, y = waiting.pop()
            found = left.pop((x, y), None)
            if found is not None:
                group += found
                waiting += [(x + i, y + j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (x + i, y + j) in left]
        groups.append(group)
    return groups

# SPDX-License-Identifier: Apache-2.0
"""What is kept beside a divided map: where its frame lies, and what it was made of."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

from shmmap.origin.map_frame import REPORT_HEAD, REPORT_NAME

__all__ = ["LINK_NAME", "DividedMap", "write_report"]

LINK_NAME: Final = "map"
"""Beside the divisions of a served cloud, this leads to the one in service."""


@dataclass(frozen=True, slots=True)
class DividedMap:
    """What was made; also kept in the map as ``shmmap_divide.json``.

    Attributes
    ----------
    path
        The map directory.
    cells, points
        Files, and points in them.
    points_read, dropped
        Points in the inputs, and how many were not finite.
    origin
        Where the map's frame lies in that of the inputs: add it to a point to come back, metres.
    crs, unit_m
        The inputs' coordinate system and unit, as in `shmmap.origin.map_frame.MapFrame`.
    cell_size, leaf, encoding
        As in `DivideSettings`.
    fields
        Names and dtypes of what each point has.
    bounds
        Least and greatest coordinates of the points that were divided, in the frame of the map.
    sources
        The inputs: path, bytes, mtime_ns, points.
    notes
        What a person should know.
    resumed_points
        Points that an earlier, killed run had divided.
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
    text = json.dumps(content, indent=1, allow_nan=False) + "\n"  # ASCII: a path may be no Unicode
    Path(directory, REPORT_NAME).write_text(text, encoding="ascii")

# SPDX-License-Identifier: Apache-2.0
"""A drive as one SVG picture: its path on the map, its errors, its latencies."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shmmap.formats.svg import PALE, Axes, Page, box_around, dash, element, swatch
from shmmap_clients.ndt_scan_matcher.drive.drive_summary import pose_errors
from shmmap_clients.ndt_scan_matcher.drive.follower import Frame
from shmmap_clients.ndt_scan_matcher.map.voxel_map import VoxelCell, VoxelMap
from shmmap_clients.spread import Decimated

_WIDTH: Final = 900.0
_MARGIN: Final = 60.0
_PATH_HEIGHT: Final = 320.0
_CHART_HEIGHT: Final = 100.0
_BESIDE_M: Final = 25.0  # of the map, on each side of the path
_OURS, _TRUTH, _BAD, _SECOND = "#1f6fb4", "#999999", "#c0392b", "#e08e0b"
_GROUND, _WALL = "#e4e7eb", "#868e96"


class _Row(NamedTuple):
    """Plotted values of one frame."""

    ours: tuple[float, float]
    truth: tuple[float, float] | None
    error_m: float
    error_deg: float
    latency_ms: float
    align_ms: float
    nvtl: float


class DrivePlot:
    """Collector of a drive's plotted frames; on long drives every k-th, also of the untrusted ones."""

    def __init__(self) -> None:
        self._frames = 0
        self._rows: Decimated[_Row] = Decimated()
        self._untrusted: Decimated[tuple[float, float]] = Decimated()
        self._map: VoxelMap | None = None
        self._leaf = 1.0
        self._columns: dict[
            str, NDArray[np.int32]
        ] = {}  # of each cell: place on the lattice, voxels above it

    def add(self, frame: Frame, voxel_map: VoxelMap | None = None) -> None:
        """Add the next frame, and the map that it was aligned with."""
        if voxel_map is not None and voxel_map is not self._map:
            self._map, self._leaf = voxel_map, voxel_map.leaf
            for key, cell in voxel_map.cells.items():
                if key not in self._columns:
                    self._columns[key] = _columns(cell)
        T, truth = frame.result.T_map_base, frame.T_truth
        error_m = error_deg = math.nan
        if truth is not None:
            metres, degrees = pose_errors(T[None], truth[None])
            error_m, error_deg = float(metres[0]), float(degrees[0])
        place = (float(T[0, 3]), float(T[1, 3]))
        # the first scan waits for the map: its latency would flatten all others
        times = (frame.latency_s * 1e3, frame.align_s * 1e3) if self._frames else (math.nan, math.nan)
        true_place = None if truth is None else (float(truth[0, 3]), float(truth[1, 3]))
        self._rows.add(_Row(place, true_place, error_m, error_deg, *times, frame.result.nvtl))
        if not frame.result.trustworthy:
            self._untrusted.add(place)
        self._frames += 1

    def svg(self) -> str:
        """Return the picture: the path (with the truth below it), then charts over the scans."""
        rows, untrusted = self._rows.values, self._untrusted.values
        page = Page(_WIDTH, f"{self._frames} scans", margin=_MARGIN)
        page.heading(30, f"{self._frames} scans")
        ours = [row.ours for row in rows]
        truth = [row.truth for row in rows if row.truth is not None]
        box, columns = box_around([*ours, *truth, *untrusted]), list(self._columns.values())
        if columns:
            box = (box[0] - _BESIDE_M, box[1] - _BESIDE_M, box[2] + _BESIDE_M, box[3] + _BESIDE_M)
        axes = Axes.fitted(page, box, 50, _PATH_HEIGHT)
        if columns:
            _draw_map(axes, np.concatenate(columns), self._leaf)
        axes.coordinates(font_size=12, fill=PALE)
        axes.line(truth, stroke=_TRUTH, stroke_width=4)
        axes.line(ours, stroke=_OURS, stroke_width=1.5)
        for x, y in untrusted:
            axes.dot(x, y, 3, fill=_BAD)
        entries = [(dash(stroke=_OURS, stroke_width=1.5), "poses")]
        if columns:
            entries += [(swatch(fill=_GROUND), "map: ground"), (swatch(fill=_WALL), "walls")]
        if truth:
            entries.append((dash(stroke=_TRUTH, stroke_width=4), "truth"))
        if untrusted:
            entries.append((element("circle", cx=9, cy=-5, r=3, fill=_BAD), "not trusted"))
        top = axes.legend(axes.bottom + 48, entries) + 56
        charts = [
            (
                "latency (blue) and alignment (orange), ms",
                {_OURS: [row.latency_ms for row in rows], _SECOND: [row.align_ms for row in rows]},
            ),
            ("NVTL", {_OURS: [row.nvtl for row in rows]}),
        ]
        if rows and len(truth) == len(rows):
            charts[:0] = [
                ("error, metres", {_BAD: [row.error_m for row in rows]}),
                ("error, degrees", {_BAD: [row.error_deg for row in rows]}),
            ]
        for title, lines in charts:
            _chart(page, top, title, lines)
            top += _CHART_HEIGHT + 50
        return page.svg(top - 30)


def _columns(cell: VoxelCell) -> NDArray[np.int32]:
    """Return the lattice columns of a cell that have voxels: i, j and their number, (N, 3)."""
    voxels = np.count_nonzero(cell.lattice >= 0, axis=2)
    i, j = np.nonzero(voxels)
    found = np.column_stack([i + cell.lattice_origin[0], j + cell.lattice_origin[1], voxels[i, j]])
    return found.astype(np.int32)


def _draw_map(axes: Axes, columns: NDArray[np.int32], leaf: float) -> None:
    """Draw the map's lattice columns: ground, and over it what is higher than that."""
    low_x, low_y, high_x, high_y = axes.box
    x, y = columns[:, 0] * leaf, columns[:, 1] * leaf
    shown = columns[(x > low_x - leaf) & (x < high_x) & (y > low_y - leaf) & (y < high_y)].astype(np.int64)
    walls = shown[:, 2] > 2
    if len(shown):
        with axes.clipped():
            parts = [(shown[~walls, :2], _rgba(_GROUND)), (shown[walls, :2], _rgba(_WALL))]
            axes.raster(parts, leaf)


def _rgba(colour: str) -> tuple[int, ...]:
    return (*bytes.fromhex(colour[1:]), 255)


def value_label(value: float) -> str:
    """Return a positive value in at most seven characters, which fit into the margin."""
    if 1e-3 <= value < 1000:
        return f"{value:.3g}"
    return f"{value:,.0f}" if 1000 <= value < 999_999.5 else f"{value:.0e}"


def _chart(page: Page, top: float, title: str, lines: Mapping[str, Sequence[float]]) -> None:
    """Draw values over the scan number, one line for each colour."""
    every = [value for values in lines.values() for value in values if math.isfinite(value)]
    most = max(every, default=0.0) or 1.0
    last = max(1, *(len(values) - 1 for values in lines.values()))
    axes = Axes(page, (0.0, 0.0, last, most), page.margin, top, page.right - page.margin, _CHART_HEIGHT)
    axes.frame(title, y_labels=[(0.0, "0"), (most, value_label(most))])
    for colour, values in lines.items():
        axes.line(enumerate(values), stroke=colour)

# SPDX-License-Identifier: Apache-2.0
"""A drive as one SVG picture: its way, its errors, its latencies."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shmmap_clients.ndt_scan_matcher.drive.follower import Frame
from shmmap_clients.ndt_scan_matcher.drive.trajectory_error import pose_errors
from shmmap_clients.spread import Decimated

__all__ = ["DrivePlot"]

_WIDTH: Final = 900
_WAY_HEIGHT: Final = 420
_CHART_HEIGHT: Final = 150
_MARGIN: Final = 60
_COLOURS: Final = {"ours": "#1f6fb4", "truth": "#999999", "error": "#c0392b", "second": "#e08e0b"}


class _Row(NamedTuple):
    """What is drawn of one frame."""

    ours: tuple[float, float]
    truth: tuple[float, float] | None
    error_m: float
    error_deg: float
    latency_ms: float
    align_ms: float
    nvtl: float


class DrivePlot:
    """Collects what is drawn of a drive; of a long one every k-th frame, and so of those not trusted."""

    def __init__(self) -> None:
        self._frames = 0
        self._rows: Decimated[_Row] = Decimated()
        self._untrusted: Decimated[tuple[float, float]] = Decimated()

    def add(self, frame: Frame) -> None:
        """Take the next frame."""
        T, truth = frame.result.T_map_base, frame.T_truth
        error_m = error_deg = math.nan
        if truth is not None:
            metres, degrees = pose_errors(T[None], truth[None])
            error_m, error_deg = float(metres[0]), float(degrees[0])
        place = (float(T[0, 3]), float(T[1, 3]))
        # the first scan waits for the map: it would flatten all others
        times = (frame.latency_s * 1e3, frame.align_s * 1e3) if self._frames else (math.nan, math.nan)
        true_place = None if truth is None else (float(truth[0, 3]), float(truth[1, 3]))
        self._rows.add(_Row(place, true_place, error_m, error_deg, *times, frame.result.nvtl))
        if not frame.result.trustworthy:
            self._untrusted.add(place)
        self._frames += 1

    def svg(self) -> str:
        """Return the picture: the trajectory (with the truth below it), then charts over the scans."""
        rows = self._rows.values
        title = f"{self._frames} scans: poses (blue), truth (grey), not trusted (red)"
        parts = [_way(title, rows, np.array(self._untrusted.values).reshape(-1, 2))]
        top = _WAY_HEIGHT
        charts: list[tuple[str, dict[str, list[float]]]] = []
        if rows and all(row.truth is not None for row in rows):
            charts.append(("error, metres", {"error": [row.error_m for row in rows]}))
            charts.append(("error, degrees", {"error": [row.error_deg for row in rows]}))
        late = {"ours": [row.latency_ms for row in rows[1:]], "second": [row.align_ms for row in rows[1:]]}
        charts.append(("latency (blue) and alignment (orange), ms", late))
        charts.append(("NVTL", {"ours": [row.nvtl for row in rows]}))
        for name, lines in charts:
            parts.append(_chart(name, {colour: np.array(values) for colour, values in lines.items()}, top))
            top += _CHART_HEIGHT
        head = (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{_WIDTH}" height="{top}"'
            ' font-family="sans-serif" font-size="12"><rect width="100%" height="100%" fill="white"/>'
        )
        return "\n".join([head, *parts, "</svg>", ""])


def _line(x: NDArray[np.float64], y: NDArray[np.float64], colour: str, width: float) -> str:
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
    return f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="{width}"/>'


def _way(title: str, rows: Sequence[_Row], untrusted: NDArray[np.float64]) -> str:
    ours = np.array([row.ours for row in rows]).reshape(-1, 2)
    truth = np.array([row.truth for row in rows if row.truth is not None]).reshape(-1, 2)
    every = np.concatenate([ours, truth, untrusted])
    if not len(every):
        return ""
    low, high = every.min(axis=0), every.max(axis=0)
    scale = min(
        (_WIDTH - 2 * _MARGIN) / max(high[0] - low[0], 1.0), (_WAY_HEIGHT - 100) / max(high[1] - low[1], 1.0)
    )

    def placed(way: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return _MARGIN + (way[:, 0] - low[0]) * scale, _WAY_HEIGHT - 50 - (way[:, 1] - low[1]) * scale

    marks = [
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{_COLOURS["error"]}"/>'
        for x, y in zip(*placed(untrusted), strict=True)
    ]
    bar = 10 ** np.floor(np.log10(max(high[0] - low[0], high[1] - low[1], 10.0)))
    end, level = _MARGIN + bar * scale, _WAY_HEIGHT - 15
    return "\n".join(
        [
            f'<text x="{_MARGIN}" y="24">{title}</text>',
            _line(*placed(truth), _COLOURS["truth"], 4.0),
            _line(*placed(ours), _COLOURS["ours"], 1.5),
            *marks,
            f'<line x1="{_MARGIN}" x2="{end:.1f}" y1="{level}" y2="{level}" stroke="black"/>',
            f'<text x="{_MARGIN}" y="{level - 5}">{bar:.0f} m</text>',
        ]
    )


def _chart(title: str, lines: dict[str, NDArray[np.float64]], top: int) -> str:
    most = max((float(values.max()) for values in lines.values() if len(values)), default=0.0) or 1.0
    bottom, height = top + _CHART_HEIGHT - 20, _CHART_HEIGHT - 50
    parts = [
        f'<text x="{_MARGIN}" y="{top + 20}">{title}</text>',
        f'<text x="{_MARGIN - 6}" y="{bottom - height + 4}" text-anchor="end">{most:.3g}</text>',
        f'<text x="{_MARGIN - 6}" y="{bottom + 4}" text-anchor="end">0</text>',
        f'<line x1="{_MARGIN}" x2="{_WIDTH - _MARGIN}" y1="{bottom}" y2="{bottom}" stroke="#cccccc"/>',
    ]
    for colour, values in lines.items():
        x = _MARGIN + np.linspace(0.0, _WIDTH - 2 * _MARGIN, max(len(values), 1))[: len(values)]
        parts.append(_line(x, bottom - values / most * height, _COLOURS[colour], 1.0))
    return "\n".join(parts)

# SPDX-License-Identifier: Apache-2.0
"""A drive as one SVG picture: its way, its errors, its latencies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap_clients.ndt_scan_matcher.drive.follower import Frame
from shmmap_clients.ndt_scan_matcher.drive.trajectory_error import pose_errors

__all__ = ["drive_svg"]

_WIDTH: Final = 900
_WAY_HEIGHT: Final = 420
_CHART_HEIGHT: Final = 150
_MARGIN: Final = 60
_COLOURS: Final = {"ours": "#1f6fb4", "truth": "#999999", "error": "#c0392b", "second": "#e08e0b"}


def drive_svg(frames: Sequence[Frame]) -> str:
    """Return the picture: the trajectory (with the truth below it), then charts over the scans."""
    poses = np.array([frame.result.T_map_base for frame in frames]).reshape(-1, 4, 4)
    parts = [_way(frames, poses)]
    top = _WAY_HEIGHT
    charts: list[tuple[str, dict[str, NDArray[np.float64]]]] = []
    if frames and all(frame.T_truth is not None for frame in frames):
        metres, degrees = pose_errors(poses, np.array([frame.T_truth for frame in frames]))
        charts.append(("error, metres", {"error": metres}))
        charts.append(("error, degrees", {"error": degrees}))
    # the first scan waits for the map: it would flatten all others
    late = np.array([frame.latency_s for frame in frames][1:]) * 1e3
    align = np.array([frame.align_s for frame in frames][1:]) * 1e3
    charts.append(("latency (blue) and alignment (orange), ms", {"ours": late, "second": align}))
    charts.append(("NVTL", {"ours": np.array([frame.result.nvtl for frame in frames])}))
    for title, lines in charts:
        parts.append(_chart(title, lines, top))
        top += _CHART_HEIGHT
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{_WIDTH}" height="{top}"'
        ' font-family="sans-serif" font-size="12"><rect width="100%" height="100%" fill="white"/>'
    )
    return "\n".join([head, *parts, "</svg>", ""])


def _line(x: NDArray[np.float64], y: NDArray[np.float64], colour: str, width: float) -> str:
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
    return f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="{width}"/>'


def _way(frames: Sequence[Frame], poses: NDArray[np.float64]) -> str:
    ours = poses[:, :2, 3]
    truth = np.array([frame.T_truth[:2, 3] for frame in frames if frame.T_truth is not None]).reshape(-1, 2)
    every = np.concatenate([ours, truth])
    if not len(every):
        return ""
    low, high = every.min(axis=0), every.max(axis=0)
    scale = min(
        (_WIDTH - 2 * _MARGIN) / max(high[0] - low[0], 1.0), (_WAY_HEIGHT - 100) / max(high[1] - low[1], 1.0)
    )

    def placed(way: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return _MARGIN + (way[:, 0] - low[0]) * scale, _WAY_HEIGHT - 50 - (way[:, 1] - low[1]) * scale

    bad = ours[[not frame.result.trustworthy for frame in frames]]
    marks = [
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{_COLOURS["error"]}"/>'
        for x, y in zip(*placed(bad), strict=True)
    ]
    bar = 10 ** np.floor(np.log10(max(high[0] - low[0], high[1] - low[1], 10.0)))
    title = f"{len(frames)} scans: poses (blue), truth (grey), not to be trusted (red)"
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

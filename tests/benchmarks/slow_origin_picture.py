# SPDX-License-Identifier: Apache-2.0
"""Drives beside a slow origin as one SVG: where the vehicle had to wait, how long, and what was fetched."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from tests.benchmarks.slow_origin_counts import Counts, Query
from tests.benchmarks.slow_origin_model import Outages

__all__ = ["drive_picture"]

_COLUMN: Final = 316
_GAP: Final = 34
_LEFT: Final = 52
_MAP_TOP: Final = 112
_MAP_HEIGHT: Final = 250
_CHART_HEIGHT: Final = 96
_WARM, _LATE, _AHEAD, _USED, _BAND = "#2b8a3e", "#c92a2a", "#1f6fb4", "#adb5bd", "#ffe8cc"
_INK, _AXIS = "#1f2933", "#ced4da"
_STYLE: Final = """
  text { font-family: system-ui, "DejaVu Sans", sans-serif; font-size: 13px; fill: #1f2933; }
  .title { font-size: 18px; font-weight: 600; }
  .head { font-size: 15px; font-weight: 600; }
  .small { font-size: 11px; fill: #52606d; }
"""
_NAMES: Final = {
    "none": "nothing fetched ahead",
    "no route": "fetched ahead",
    "route": "fetched ahead, route told",
}


def drive_picture(drives: dict[str, Counts], mean_s: float, outages: Outages) -> str:
    """Return one column for each drive: its way, how long each query waits, and cells over time.

    Parameters
    ----------
    drives
        By the name of their row, all along the same way.
    mean_s, outages
        Of the origin; outages are drawn as bands.
    """
    queries = next(iter(drives.values())).queries
    end_s = queries[-1].asked_s
    longest_s = max(query.stall_s for counts in drives.values() for query in counts.counted)
    most = max(query.fetched for counts in drives.values() for query in counts.queries)
    width = _LEFT + len(drives) * (_COLUMN + _GAP)
    stall_top = _MAP_TOP + _MAP_HEIGHT + 34
    cells_top = stall_top + _CHART_HEIGHT + 44
    height = cells_top + _CHART_HEIGHT + 40
    size = f'width="{width}" height="{height}" viewBox="0 0 {width} {height}"'
    times = f"every {outages.period_s:.0f} s nothing comes for {outages.length_s:.0f} s (bands)"
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" {size}><style>{_STYLE}</style>',
        '<rect width="100%" height="100%" fill="white"/>',
        _text(_LEFT, 30, "A vehicle whose map comes from a slow place", "title"),
        _text(_LEFT, 52, f"each cell takes {mean_s:g} s on average, eight at a time; {times}"),
        _key(width - _GAP - 300.0, 24.0),
    ]
    for number, (row, counts) in enumerate(drives.items()):
        left = _LEFT + number * (_COLUMN + _GAP)
        complete = f"{100 * counts.warm:.1f} % of queries complete at once"
        parts += [
            _text(left, 84, _NAMES.get(row, row), "head"),
            _text(left, 103, f"{complete}, {counts.late} cells late"),
            _way(counts.queries, left, counts.full_s),
            _bands(outages, end_s, left, stall_top),
            _bands(outages, end_s, left, cells_top),
            _frame("waited for the last cell, s", left, stall_top, longest_s, end_s, first=number == 0),
            _frame("cells fetched, asked for", left, cells_top, most, end_s, first=number == 0),
            _bars(counts.counted, left, stall_top, longest_s, end_s),
            _line(counts.queries, lambda query: query.fetched, left, cells_top, most, end_s, _AHEAD),
            _line(counts.queries, lambda query: query.used, left, cells_top, most, end_s, _USED),
        ]
    return "\n".join([*parts, "</svg>", ""])


def _text(x: float, y: float, text: str, kind: str = "") -> str:
    return f'<text class="{kind}" x="{x:.1f}" y="{y:.1f}">{text}</text>'


def _stroke(x0: float, y0: float, x1: float, y1: float, colour: str, wide: float) -> str:
    ends = f'x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}"'
    return f'<line {ends} stroke="{colour}" stroke-width="{wide:.1f}" stroke-linecap="round"/>'


def _key(left: float, y: float) -> str:
    """What the colours mean."""
    entries = [(_WARM, "complete at once"), (_LATE, "had to wait"), (_AHEAD, "fetched"), (_USED, "asked for")]
    parts = []
    for at, (colour, text) in enumerate(entries):
        x = left + 150.0 * (at % 2)
        top = y + 20.0 * (at // 2)
        parts += [_stroke(x, top - 4, x + 18, top - 4, colour, 4.0), _text(x + 24, top, text)]
    return "\n".join(parts)


def _way(queries: Sequence[Query], left: float, full_s: float) -> str:
    """The way from above: where queries were complete at once, and, wider the longer it took, where not."""
    at = np.array([(query.x, query.y) for query in queries])
    low, high = at.min(axis=0), at.max(axis=0)
    scale = min((_COLUMN - 8) / (high[0] - low[0]), (_MAP_HEIGHT - 26) / (high[1] - low[1]))
    x = left + 4 + (at[:, 0] - low[0]) * scale
    y = _MAP_TOP + _MAP_HEIGHT - 18 - (at[:, 1] - low[1]) * scale
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
    parts = [f'<polyline points="{points}" fill="none" stroke="{_WARM}" stroke-width="2.5"/>']
    for number, query in enumerate(queries[1:], 1):
        if query.late and query.asked_s >= full_s:
            wide = 3.0 + min(query.stall_s, 9.0)
            parts.append(_stroke(x[number - 1], y[number - 1], x[number], y[number], _LATE, wide))
    bottom, end = _MAP_TOP + _MAP_HEIGHT - 2, left + 4 + 500 * scale
    parts += [
        f'<circle cx="{x[0]:.1f}" cy="{y[0]:.1f}" r="4" fill="{_INK}"/>',
        _stroke(left + 4, bottom, end, bottom, _INK, 1.0),
        _text(end + 6, bottom + 4, "500 m", "small"),
    ]
    return "\n".join(parts)


def _bands(outages: Outages, end_s: float, left: float, top: float) -> str:
    starts = np.arange(outages.first_s, end_s, outages.period_s)
    wide = outages.length_s / end_s * _COLUMN
    return "\n".join(
        f'<rect x="{left + begin / end_s * _COLUMN:.1f}" y="{top}" width="{wide:.1f}"'
        f' height="{_CHART_HEIGHT}" fill="{_BAND}"/>'
        for begin in starts.tolist()
    )


def _frame(title: str, left: float, top: float, most: float, end_s: float, *, first: bool) -> str:
    """The lines about a chart, its title and its scale."""
    bottom = top + _CHART_HEIGHT
    marks = [
        f'<text class="small" x="{left + minute * 60 / end_s * _COLUMN:.1f}" y="{bottom + 14}"'
        f' text-anchor="middle">{minute} min</text>'
        for minute in range(0, int(end_s // 60) + 1, 2)
    ]
    scale = [
        f'<text class="small" x="{left - 6}" y="{top + 10}" text-anchor="end">{most:.0f}</text>',
        f'<text class="small" x="{left - 6}" y="{bottom}" text-anchor="end">0</text>',
    ]
    return "\n".join(
        [
            _stroke(left, bottom, left + _COLUMN, bottom, _AXIS, 1.0),
            _text(left, top - 6, title, "small"),
            *marks,
            *(scale if first else []),
        ]
    )


def _bars(queries: Sequence[Query], left: float, top: float, most: float, end_s: float) -> str:
    """How long each query waited."""
    bottom = top + _CHART_HEIGHT
    waited = [query for query in queries if query.stall_s > 0.0]
    at = [left + query.asked_s / end_s * _COLUMN for query in waited]
    tops = [bottom - query.stall_s / most * _CHART_HEIGHT for query in waited]
    return "\n".join(_stroke(x, bottom, x, y, _LATE, 1.0) for x, y in zip(at, tops, strict=True))


def _line(
    queries: Sequence[Query], of: Callable[[Query], float], left: float, top: float, most: float,
    end_s: float, colour: str,
) -> str:  # fmt: skip
    points = " ".join(
        f"{left + query.asked_s / end_s * _COLUMN:.1f},"
        f"{top + _CHART_HEIGHT - of(query) / most * _CHART_HEIGHT:.1f}"
        for query in queries
    )
    return f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="1.8"/>'

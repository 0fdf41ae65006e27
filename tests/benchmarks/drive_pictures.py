# SPDX-License-Identifier: Apache-2.0
"""Drives as one SVG, a column each: where the vehicle had to wait, how long, and what was loaded."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.formats.svg import INK, Axes, Page, box_around, dash, swatch
from tests.benchmarks.slow_origin_counts import Counts
from tests.benchmarks.slow_origin_model import Outages

if TYPE_CHECKING:
    from tests.benchmarks.vehicle_day import Day

__all__ = ["day_picture", "drive_picture"]

_MARGIN: Final = 60.0
_GAP: Final = 60.0
_HEAD: Final = 130.0
_CHART_HEIGHT: Final = 100.0
_CHART_STEP: Final = 160.0
_WARM, _LATE, _LOADED, _SECOND, _BAND = "#2b8a3e", "#c92a2a", "#1f6fb4", "#adb5bd", "#ffe8cc"
_COLOURS_OF_WAITS: Final = [
    (dash(stroke=_WARM, stroke_width=4), "complete at once"),
    (dash(stroke=_LATE, stroke_width=4), "had to wait"),
    (swatch(fill=_BAND), "nothing comes"),
]
_NAMES: Final = {
    "none": "nothing fetched ahead",
    "no route": "fetched ahead",
    "route": "fetched ahead, with the route",
}
_TITLES: Final = {"places": "with positions only", "route": "with the route, too"}
_RATE_S: Final = 20.0
"""Traffic of the link is averaged over this time, seconds."""


@dataclass(frozen=True)
class _Column:
    """A drive's column: heading and path, and charts over its time below.

    Attributes
    ----------
    width, map_height
        Pixels.
    outages
        From when to when, seconds.
    factor
        How much faster than the time that is written the drive was.
    mark_min
        Minutes from one label of time to the next.
    """

    page: Page
    number: int
    width: float
    map_height: float
    end_s: float
    outages: Sequence[tuple[float, float]]
    factor: float
    mark_min: int

    @property
    def left(self) -> float:
        return _MARGIN + self.number * (self.width + _GAP)

    def path(
        self, title: str, note: str, places: Sequence[tuple[float, float]], waits_s: Sequence[float | None]
    ) -> None:
        """Draw the path from above, red where the vehicle waited: wider the longer it took.

        Parameters
        ----------
        places, waits_s
            Of each query: where, metres; and how long it waited, None if it did not.
        """
        self.page.text(self.left, _HEAD, title, font_size=16, font_weight=600)
        self.page.text(self.left, _HEAD + 20, note, font_size=13)
        axes = Axes.fitted(
            self.page,
            box_around(places),
            _HEAD + 36,
            self.map_height - 30,
            left=self.left,
            max_width=self.width,
        )
        axes.line(places, stroke=_WARM, stroke_width=2.4)
        for stretch, wait_s in zip(itertools.pairwise(places), waits_s[1:], strict=True):
            if wait_s is not None:
                axes.line(stretch, stroke=_LATE, stroke_width=3 + min(wait_s, 9.0), stroke_linecap="round")
        axes.dot(*places[0], 4, fill=INK)
        axes.scale_bar(_HEAD + 30 + self.map_height, right=self.left + self.width)

    def chart(self, number: int, title: str, most: float, unit: str = "") -> Axes:
        """Return the axes of a chart over the drive's time, with outages behind."""
        top = _chart_top(self.map_height, number)
        axes = Axes(self.page, (0.0, 0.0, self.end_s, most), self.left, top, self.width, _CHART_HEIGHT)
        bands = [(begin_s, 0.0, min(end_s, self.end_s), most) for begin_s, end_s in self.outages]
        axes.rectangles(bands, fill=_BAND)
        minutes = range(0, int(self.end_s * self.factor // 60) + 1, self.mark_min)
        axes.frame(
            title,
            x_labels=[(minute * 60 / self.factor, f"{minute} min") for minute in minutes],
            y_labels=[(0.0, "0"), (most, f"{most:.0f} {unit}")],
        )
        return axes


def _chart_top(map_height: float, number: int) -> float:
    """Upper edge of a chart, pixels."""
    return _HEAD + map_height + 80 + number * _CHART_STEP


def drive_picture(drives: dict[str, Counts], mean_s: float, outages: Outages) -> str:
    """Draw drives beside a slow origin: the path, how long each query waits, and cells over time.

    Parameters
    ----------
    drives
        By the name of their row, all along the same path.
    mean_s, outages
        Of the origin.
    """
    width, map_height = 316.0, 250.0
    end_s = next(iter(drives.values())).queries[-1].asked_s
    longest_s = max(query.stall_s for counts in drives.values() for query in counts.counted)
    most = max(query.fetched for counts in drives.values() for query in counts.queries)
    starts = np.arange(outages.first_s, end_s, outages.period_s).tolist()
    bands = [(begin_s, begin_s + outages.length_s) for begin_s in starts]
    title = "A vehicle whose map comes from a slow place"
    page = Page(_MARGIN + len(drives) * (width + _GAP), title, margin=_MARGIN)
    times = f"every {outages.period_s:.0f} s nothing comes for {outages.length_s:.0f} s"
    page.heading(36, title, f"each cell takes {mean_s:g} s on average, eight at a time; {times}")
    cells = [(dash(stroke=_LOADED), "cells fetched"), (dash(stroke=_SECOND), "of them requested")]
    page.legend(86, [*_COLOURS_OF_WAITS, *cells])
    for number, (row, counts) in enumerate(drives.items()):
        column = _Column(page, number, width, map_height, end_s, bands, factor=1.0, mark_min=2)
        column.path(
            _NAMES.get(row, row),
            f"{100 * counts.warm:.1f} % of queries complete at once, {counts.late} cells late",
            [(query.x, query.y) for query in counts.queries],
            [
                query.stall_s if query.late and query.asked_s >= counts.full_s else None
                for query in counts.queries
            ],
        )
        waits = column.chart(0, "waited for the last cell, s", longest_s)
        for query in counts.counted:
            if query.stall_s > 0.0:
                waits.line([(query.asked_s, 0.0), (query.asked_s, query.stall_s)], stroke=_LATE)
        loads = column.chart(1, "cells fetched, requested", most)
        loads.line(
            [(query.asked_s, query.fetched) for query in counts.queries], stroke=_LOADED, stroke_width=1.8
        )
        loads.line(
            [(query.asked_s, query.used) for query in counts.queries], stroke=_SECOND, stroke_width=1.8
        )
    return page.svg(_chart_top(map_height, 2) - 20)


def day_picture(days: Sequence[Day], factor: float) -> str:
    """Draw drives of a vehicle's day: the path, how long each query waits, the link and the memory.

    Parameters
    ----------
    factor
        How much faster than a real hour they were.
    """
    width, map_height = 640.0, 400.0
    end_s = days[0].queries[-1].asked_s
    title = f"{end_s * factor / 60:.0f} minutes of driving over a published map of a million cells"
    page = Page(_MARGIN + len(days) * (width + _GAP), title, margin=_MARGIN)
    speed = f"driven {factor:g} times as fast" if factor > 1 else "in real time"
    page.heading(
        36, title, f"{days[0].way_km:.0f} km, {speed}; 2 GiB of memory, 8 GiB of disk, empty at the start"
    )
    page.legend(86, _COLOURS_OF_WAITS)
    rates = [_rates(day) for day in days]
    longest_s = _round_up(max(day.longest_wait_s for day in days))
    most_mb = _round_up(max(float(rate.max()) for _, rate in rates))
    for number, (day, (at_s, rate)) in enumerate(zip(days, rates, strict=True)):
        column = _Column(page, number, width, map_height, end_s, day.outages, factor, mark_min=10)
        warm = 100.0 - 100.0 * day.misses / max(1, len(day.counted))
        counted = set(map(id, day.counted))
        column.path(
            _TITLES[day.kind],
            f"{warm:.2f} % of queries complete at once, {day.misses} not; {day.mb_per_km:.0f} MB/km,"
            f" loaded / used {day.over_fetch:.2f}, from the disk {100 * day.disk_hits:.0f} %",
            [(query.x, query.y) for query in day.queries],
            [query.wait_s / 2 if query.late and id(query) in counted else None for query in day.queries],
        )
        waits = column.chart(0, "a cell was waited for, the longest of each query", longest_s, "s")
        for query in day.counted:
            if query.late:
                waits.line(
                    [(query.asked_s, 0.0), (query.asked_s, query.wait_s)], stroke=_LATE, stroke_width=1.6
                )
        link = column.chart(1, "over the link", most_mb, "MB/s")
        curve = [(at_s[0], 0.0), *zip(at_s, rate, strict=True), (at_s[-1], 0.0)]
        page.add("polygon", points=link.points(curve), fill=_LOADED)
        held = [(each.asked_s, each.resident_bytes / 2**30) for each in day.samples]
        most_gib = max(2.0, math.ceil(max(gib for _, gib in held)))
        memory = column.chart(2, "cells in memory", most_gib, "GiB")
        memory.line(held, stroke="#5f3dc4", stroke_width=1.8)
    return page.svg(_chart_top(map_height, 3) - 20)


def _round_up(value: float) -> float:
    """A round number that is not less."""
    steps = np.array([1, 2, 3, 5, 8, 10, 15, 20, 30, 40, 50, 60, 80, 100, 150, 200, 300, 500, 1000.0])
    return float(steps[min(int(np.searchsorted(steps, value)), len(steps) - 1)])


def _rates(day: Day) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Seconds since the start, and the link's megabytes per second around then."""
    at_s = np.array([sample.asked_s for sample in day.samples])
    mb = np.array([sample.received_bytes for sample in day.samples]) / 1e6
    marks = np.arange(0.0, at_s[-1], _RATE_S / 4)
    begin, end = np.clip(marks - _RATE_S / 2, at_s[0], None), np.clip(marks + _RATE_S / 2, None, at_s[-1])
    rate: NDArray[np.float64] = (np.interp(end, at_s, mb) - np.interp(begin, at_s, mb)) / (end - begin)
    return marks, rate

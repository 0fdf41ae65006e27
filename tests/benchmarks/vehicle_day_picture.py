# SPDX-License-Identifier: Apache-2.0
"""Drives of a vehicle's day as one picture: where it had to wait, how long, what came over the link."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

if TYPE_CHECKING:
    from tests.benchmarks.vehicle_day import Day

__all__ = ["day_picture"]

_SCALE: Final = 2
"""Factor by which all is drawn larger and finally reduced, for smooth lines."""
_COLUMN, _GAP, _LEFT, _TOP = 640, 70, 76, 172
_MAP_HEIGHT, _CHART_HEIGHT, _CHART_GAP = 400, 104, 62
_WARM, _LATE, _LINK, _MEMORY, _BAND = "#2b8a3e", "#c92a2a", "#1f6fb4", "#5f3dc4", "#ffe8cc"
_INK, _SOFT, _AXIS = "#1f2933", "#52606d", "#ced4da"
_TITLES: Final = {"places": "with positions only", "route": "with the route, too"}
_RATE_S: Final = 20.0
"""Traffic of the link is averaged over this time, seconds."""
_Place = tuple[float, float]


class _Sheet:
    """A picture that is being drawn, in pixels of the result."""

    def __init__(self, width: int, height: int) -> None:
        self.image = Image.new("RGB", (width * _SCALE, height * _SCALE), "white")
        self._draw = ImageDraw.Draw(self.image)

    def line(self, places: Sequence[_Place], colour: str, wide: float) -> None:
        at = [(x * _SCALE, y * _SCALE) for x, y in places]
        self._draw.line(at, fill=colour, width=max(1, round(wide * _SCALE)), joint="curve")

    def dot(self, x: float, y: float, radius: float, colour: str) -> None:
        box = [(x - radius) * _SCALE, (y - radius) * _SCALE, (x + radius) * _SCALE, (y + radius) * _SCALE]
        self._draw.ellipse(box, fill=colour)

    def box(self, x0: float, y0: float, x1: float, y1: float, colour: str) -> None:
        self._draw.rectangle([x0 * _SCALE, y0 * _SCALE, max(x0 + 1, x1) * _SCALE, y1 * _SCALE], fill=colour)

    def area(self, places: Sequence[_Place], colour: str) -> None:
        self._draw.polygon([(x * _SCALE, y * _SCALE) for x, y in places], fill=colour)

    def text(
        self, x: float, y: float, text: str, *, size: int = 14, colour: str = _INK, anchor: str = "ls"
    ) -> None:
        font = ImageFont.load_default(size * _SCALE)
        self._draw.text((x * _SCALE, y * _SCALE), text, fill=colour, font=font, anchor=anchor)

    def finished(self) -> Image.Image:
        width, height = self.image.size
        return self.image.resize((width // _SCALE, height // _SCALE), Image.Resampling.LANCZOS)


class _Chart:
    """A chart over the hour: its place, and its scale."""

    def __init__(self, sheet: _Sheet, left: float, top: float, end_s: float, most: float) -> None:
        self._sheet, self._left, self._end_s, self._most = sheet, left, end_s, most
        self._top, self._bottom = top, top + _CHART_HEIGHT

    def at(self, now_s: float, value: float) -> _Place:
        """Where a value is."""
        x = self._left + now_s / self._end_s * _COLUMN
        return x, self._bottom - min(value / self._most, 1.0) * _CHART_HEIGHT

    def frame(self, title: str, unit: str, outages: Sequence[tuple[float, float]], factor: float) -> None:
        """Draw what is behind: outages, the axis, the minutes of the hour."""
        sheet = self._sheet
        for from_s, to_s in outages:
            (x0, _), (x1, _) = self.at(from_s, 0.0), self.at(min(to_s, self._end_s), 0.0)
            sheet.box(x0, self._top, x1, self._bottom, _BAND)
        sheet.line([self.at(0.0, 0.0), self.at(self._end_s, 0.0)], _AXIS, 1.0)
        sheet.text(self._left, self._top - 9, title, size=13, colour=_SOFT)
        for value in (0.0, self._most):
            _, y = self.at(0.0, value)
            label = f"{value:.0f} {unit}" if value else "0"
            sheet.text(self._left - 7, y, label, size=11, colour=_SOFT, anchor="rm")
        for minute in range(0, int(self._end_s * factor // 60) + 1, 10):
            x, _ = self.at(minute * 60 / factor, 0.0)
            sheet.text(x, self._bottom + 15, f"{minute} min", size=11, colour=_SOFT, anchor="ms")


def day_picture(days: Sequence[Day], factor: float) -> Image.Image:
    """Draw one column for each drive.

    Parameters
    ----------
    factor
        How much faster than a real hour they were.
    """
    end_s = days[0].queries[-1].asked_s
    charts_top = _TOP + _MAP_HEIGHT + 70
    height = charts_top + 3 * _CHART_HEIGHT + 2 * _CHART_GAP + 44
    sheet = _Sheet(_LEFT + len(days) * (_COLUMN + _GAP), height)
    hour = f"{end_s * factor / 60:.0f} minutes of driving"
    sheet.text(_LEFT, 40, f"{hour} over a published map of a million cells", size=24)
    speed = f"driven {factor:g} times as fast" if factor > 1 else "in real time"
    subtitle = f"{days[0].way_km:.0f} km, {speed}; 2 GiB of memory, 8 GiB of disk, empty at the start"
    sheet.text(_LEFT, 66, subtitle, colour=_SOFT)
    _key(sheet)
    rates = [_rates(day) for day in days]
    most = (
        _round_up(max(day.longest_wait_s for day in days)),
        _round_up(max(float(rate.max()) for _, rate in rates)),
        2.0,
    )
    for number, (day, (at_s, rate)) in enumerate(zip(days, rates, strict=True)):
        left = _LEFT + number * (_COLUMN + _GAP)
        _heading(sheet, day, left)
        _way(sheet, day, left)
        tops = [charts_top + each * (_CHART_HEIGHT + _CHART_GAP) for each in range(3)]
        waits, link, memory = (
            _Chart(sheet, left, top, end_s, high) for top, high in zip(tops, most, strict=True)
        )
        waits.frame("a cell was waited for, the longest of each query", "s", day.outages, factor)
        for query in day.counted:
            if query.late:
                sheet.line([waits.at(query.asked_s, 0), waits.at(query.asked_s, query.wait_s)], _LATE, 1.6)
        link.frame("over the link", "MB/s", day.outages, factor)
        curve = [link.at(s, mb) for s, mb in zip(at_s.tolist(), rate.tolist(), strict=True)]
        sheet.area([link.at(at_s[0], 0), *curve, link.at(at_s[-1], 0)], _LINK)
        memory.frame("cells in memory", "GiB", day.outages, factor)
        held = [memory.at(each.asked_s, each.resident_bytes / 2**30) for each in day.samples]
        sheet.line(held, _MEMORY, 1.8)
    return sheet.finished()


def _round_up(value: float) -> float:
    """A round number that is not less."""
    steps = np.array([1, 2, 3, 5, 8, 10, 15, 20, 30, 40, 50, 60, 80, 100, 150, 200, 300, 500, 1000.0])
    return float(steps[min(int(np.searchsorted(steps, value)), len(steps) - 1)])


def _key(sheet: _Sheet) -> None:
    """What the colours mean."""
    entries = (
        (_WARM, "all there at once", 4.0),
        (_LATE, "had to wait", 4.0),
        (_BAND, "the link is out", 14.0),
    )
    for number, (colour, text, wide) in enumerate(entries):
        left = _LEFT + 180 * number
        sheet.line([(left, 92), (left + 26, 92)], colour, wide)
        sheet.text(left + 36, 92, text, size=13, anchor="lm")


def _heading(sheet: _Sheet, day: Day, left: float) -> None:
    sheet.text(left, 134, _TITLES[day.kind], size=18)
    warm = 100.0 - 100.0 * day.misses / max(1, len(day.counted))
    found = (
        f"{warm:.2f} % of queries complete at once, {day.misses} not; {day.mb_per_km:.0f} MB/km,"
        f" loaded / used {day.over_fetch:.2f}, from the disk {100 * day.disk_hits:.0f} %"
    )
    sheet.text(left, 156, found, size=13, colour=_SOFT)


def _way(sheet: _Sheet, day: Day, left: float) -> None:
    """The way from above: where queries were complete at once and where not, wider for longer waits."""
    at = np.array([(query.x, query.y) for query in day.queries])
    low, high = at.min(axis=0), at.max(axis=0)
    scale = min((_COLUMN - 16) / max(high[0] - low[0], 1.0), (_MAP_HEIGHT - 40) / max(high[1] - low[1], 1.0))
    x = left + 8 + (at[:, 0] - low[0]) * scale
    y = _TOP + 8 + (high[1] - at[:, 1]) * scale
    places = list(zip(x.tolist(), y.tolist(), strict=True))
    sheet.line(places, _WARM, 2.4)
    counted = set(map(id, day.counted))
    for number, query in enumerate(day.queries[1:], 1):
        if query.late and id(query) in counted:
            sheet.line([places[number - 1], places[number]], _LATE, 3.5 + min(query.wait_s, 8.0) / 2)
    sheet.dot(*places[0], 5, _INK)
    sheet.text(places[0][0] + 9, places[0][1] - 6, "start", size=12)
    bottom = _TOP + _MAP_HEIGHT
    sheet.line([(left + 8, bottom), (left + 8 + 1000 * scale, bottom)], _INK, 1.5)
    sheet.text(left + 16 + 1000 * scale, bottom, "1 km", size=12, anchor="lm")


def _rates(day: Day) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Seconds since the start, and the link's megabytes per second around then."""
    at_s = np.array([sample.asked_s for sample in day.samples])
    mb = np.array([sample.received_bytes for sample in day.samples]) / 1e6
    marks = np.arange(0.0, at_s[-1], _RATE_S / 4)
    begin, end = np.clip(marks - _RATE_S / 2, at_s[0], None), np.clip(marks + _RATE_S / 2, None, at_s[-1])
    rate: NDArray[np.float64] = (np.interp(end, at_s, mb) - np.interp(begin, at_s, mb)) / (end - begin)
    return marks, rate

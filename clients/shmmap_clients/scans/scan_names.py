# SPDX-License-Identifier: Apache-2.0
"""Names of scans: their order, and the matching poses."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest
from shmmap_clients.scans.trajectory import Trajectory

_NUMBERS: Final = re.compile(r"([0-9]+)")
_DECIMAL: Final = re.compile(r"(?<![0-9.A-Za-z])[0-9]*\.[0-9]+(?![0-9.])|(?<![0-9.])[0-9]+\.[0-9]+(?![0-9.])")
_UNITS: Final = (1.0, 1e-3, 1e-6, 1e-9)  # units of times: seconds to nanoseconds
_CLOCK: Final = 1e8  # whole numbers from here on are times, not counts
_CLOSEST_S: Final = 0.05
_RENAME: Final = "give numbers the same width: 0.05 0.10 0.15, or 0001 0002 0010"


def stem(path: Path) -> str:
    """Return a scan's name without its suffix; ``.pcd.bin`` is one suffix."""
    return path.stem.removesuffix(".pcd") if path.suffix.lower() == ".bin" else path.stem


def in_order(files: Sequence[Path]) -> list[Path]:
    """Return files sorted by the numbers in their names, ``s_9`` before ``s_10``.

    A number with a point is decimal, ``0.05`` before ``0.1``, unless the digits after the point are a
    counter: ``1.9``, ``1.10``.

    Raises
    ------
    BadRequest
        Numbers may be decimal or counters, with different orders; or two files are the same scan.
    """
    by_stem: dict[str, Path] = {}
    for path in sorted(files):
        other = by_stem.setdefault(stem(path), path)
        if other is not path:
            raise BadRequest(
                f"{other.name} and {path.name} are both called {stem(path)}: which is the scan?",
                hint="keep one of them in the directory",
            )
    counted = sorted(files, key=lambda path: _words(stem(path), decimal=False))
    decimal = sorted(files, key=lambda path: _words(stem(path), decimal=True))
    if counted == decimal:
        return counted
    fractions = [word.partition(".")[::2] for path in files for word in _DECIMAL.findall(stem(path))]
    digits = [fraction for _, fraction in fractions if len(fraction) > 1]
    padded = any(fraction.startswith("0") for fraction in digits)
    rounded = any(fraction.endswith("0") for fraction in digits)
    if padded or not rounded:  # a counter without padding reaches 10, decimals have no trailing zero
        return decimal
    series: dict[str, set[int]] = {}
    for whole, fraction in fractions:
        series.setdefault(whole, set()).add(int(fraction))
    if all(max(numbers) - min(numbers) == len(numbers) - 1 for numbers in series.values()):
        return counted
    first = next(a for a, b in zip(counted, decimal, strict=True) if a != b)
    raise BadRequest(
        f"names like {first.name} have no clear order: {counted[0].name}, {counted[1].name} ... as counters,"
        f" {decimal[0].name}, {decimal[1].name} ... as decimal numbers",
        hint=_RENAME,
    )


def pair_with_poses(files: Sequence[Path], trajectory: Trajectory) -> tuple[list[int], str]:
    """Return the row of each scan's pose, and the method that found it.

    ``time``
        A number in the names, with a point or too large for a count of poses, is the time of a pose in
        seconds, milliseconds, microseconds or nanoseconds.
    ``place``
        Else, with as many poses as scans: the first scan has the first pose, and so on.
    ``number``
        Else a number that differs in all names counts the poses from 0: ``scan_0081`` has the 82nd pose.

    Parameters
    ----------
    files
        Scans, in order.
    trajectory
        Poses, in any order.

    Raises
    ------
    BadRequest
        No method fits, two methods disagree, or two scans would have the same pose.
    """
    poses = len(trajectory)
    stems = [stem(path) for path in files]
    fitting: dict[tuple[int, ...], None] = {}
    part = ""  # name of a scan without a near pose, while others have one
    for numbers in _columns(stems):
        if not any("." in word or float(word) >= max(poses, 1) for word in numbers):
            continue
        rows, near = _by_time(numbers, trajectory)
        if near.all() and (_certain(numbers) or len({*rows.tolist()}) == len(rows)):
            fitting[tuple(rows.tolist())] = None
        elif 2 * int(near.sum()) >= len(near) and _certain(numbers):
            part = stems[int(np.argmin(near))]
    if len(fitting) == 1:
        return _one_each(files, list(next(iter(fitting)))), "time"
    if not fitting and part:
        raise BadRequest(
            f"the names of the scans are times, and {part} has no pose within {_CLOSEST_S:g} s",
            hint="give a pose for each scan",
        )
    if not fitting and poses == len(files):
        return list(range(poses)), "place"
    if not fitting:
        counting = _counting(files, stems, poses)
        fitting = {tuple(rows): None for rows in counting}
    if len(fitting) > 1:
        raise BadRequest(
            f"names like {files[0].name} have several numbers that could say which pose is theirs",
            hint="leave one of them in the names, or give as many poses as scans, in their order",
        )
    return _one_each(files, list(next(iter(fitting)))), "number"


def _words(text: str, *, decimal: bool) -> tuple[list[tuple[int, float, str]], str]:
    """Return a key for sorting: the words and numbers of a name."""
    words: list[tuple[int, float, str]] = []
    end = 0
    for found in _DECIMAL.finditer(text) if decimal else ():
        words += _counters(text[end : found.start()])
        words.append((0, float(found.group()), ""))
        end = found.end()
    return words + _counters(text[end:]), text


def _counters(text: str) -> list[tuple[int, float, str]]:
    words = [word for word in _NUMBERS.split(text) if word]
    return [(0, int(word), "") if word.isdecimal() else (1, 0.0, word) for word in words]


def _columns(stems: Sequence[str]) -> list[list[str]]:
    """Return the numbers that differ in all names, by position; all names must have equally many."""
    pattern = re.compile(f"{_DECIMAL.pattern}|[0-9]+")
    found = [pattern.findall(text) for text in stems]
    if len({len(numbers) for numbers in found}) != 1:
        return []
    columns = [list(column) for column in zip(*found, strict=True)]
    return [column for column in columns if len({float(word) for word in column}) == len(column)]


def _certain(numbers: Sequence[str]) -> bool:
    """Return whether these numbers can only be times."""
    return any("." in word or float(word) >= _CLOCK for word in numbers)


def _by_time(numbers: Sequence[str], trajectory: Trajectory) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the pose nearest in time to each number, in the best unit, and a mask of the near ones."""
    order = np.argsort(trajectory.stamps_s, kind="stable")
    stamps = trajectory.stamps_s[order]
    steps = np.diff(np.unique(stamps))
    close = _CLOSEST_S
    if len(steps) and not _certain(numbers):  # counts are near to dense poses by chance
        close = min(close, float(np.median(steps)) / 2)
    best = np.zeros(len(numbers), np.int64), np.zeros(len(numbers), np.bool_)
    for unit in _UNITS:
        times = np.array([float(word) * unit for word in numbers])
        after = np.searchsorted(stamps, times).clip(1, max(1, len(stamps) - 1))
        before = after - 1
        after = after.clip(max=len(stamps) - 1)
        nearest = np.where(times - stamps[before] <= stamps[after] - times, before, after)
        near = np.abs(stamps[nearest] - times) <= close
        if near.sum() > best[1].sum():
            best = order[nearest], near
    return best


def _counting(files: Sequence[Path], stems: Sequence[str], poses: int) -> list[list[int]]:
    """Return possible rows for whole numbers in the names, at least one choice."""
    columns = _columns(stems)
    choices = [
        [int(word) for word in column]
        for column in columns
        if all("." not in word and int(word) < poses for word in column)
    ]
    if choices:
        return choices
    rows = []
    for path, text in zip(files, stems, strict=True):
        numbers = _NUMBERS.findall(text)
        if not numbers or int(numbers[-1]) >= poses:
            raise BadRequest(
                f"{poses} poses do not fit {len(files)} scans: {path.name} has no number of one of them in"
                " its name, and no time of one",
                hint="give a pose for each scan, or number the scans by the poses' lines, from 0",
            )
        rows.append(int(numbers[-1]))
    return [rows]


def _one_each(files: Sequence[Path], rows: list[int]) -> list[int]:
    scans: dict[int, Path] = {}
    for path, row in zip(files, rows, strict=True):
        other = scans.setdefault(row, path)
        if other is not path:
            raise BadRequest(
                f"{other.name} and {path.name} would both have pose {row}",
                hint="give a pose for each scan, in the order of their names",
            )
    return rows

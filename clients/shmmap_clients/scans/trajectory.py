# SPDX-License-Identifier: Apache-2.0
"""Poses by time, in the TUM format: ``t tx ty tz qx qy qz qw`` on each line; and routes."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest, MapDataError
from shmmap.errors import MapMissing

_NORM_TOLERANCE = 1e-2
_UNITS: Final = (("seconds", 1.0), ("milliseconds", 1e-3), ("microseconds", 1e-6), ("nanoseconds", 1e-9))
_CLOCK_S: Final = (5e8, 5e9)  # times of clocks: 1985 to 2128
_SPARSE_S: Final = 30.0  # poses further apart are not those of a drive
_APART: Final = 100.0  # units are 1000 apart, times of clocks far less
_LONGEST_STEP: Final = 2.0  # of seconds
_SHORTEST_STEP: Final = 2e3  # of microseconds: 500 poses a second
_LARGEST: Final = 1e20  # above times in nanoseconds
_COUNTED: Final = 1e6  # no drive has more frames
_LYING: Final = math.cos(math.radians(60.0))
_UPRIGHT: Final = math.cos(math.radians(20.0))


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses of a sensor in the order of a file.

    Attributes
    ----------
    stamps_s
        (N,) float64, seconds.
    T_map_sensor
        (N, 4, 4) float64, metres.
    notes
        What a user should know of how the file was read.
    """

    stamps_s: NDArray[np.float64]
    T_map_sensor: NDArray[np.float64]
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        times = f", {self.stamps_s[0]:.3f} to {self.stamps_s[-1]:.3f} s" if len(self) else ""
        return f"<Trajectory of {len(self)} poses{times}>"

    def __len__(self) -> int:
        return len(self.stamps_s)


def matrix_of(translation: Iterable[float], quaternion: Iterable[float]) -> NDArray[np.float64]:
    """Return the (4, 4) pose of a translation (metres) and a quaternion (x, y, z, w), normalised.

    Raises
    ------
    BadRequest
        The quaternion is zero or not finite.
    """
    x, y, z, w = quaternion
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    if not (math.isfinite(norm) and norm > 0):
        raise BadRequest(f"the quaternion {x:g},{y:g},{z:g},{w:g} is no rotation")
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    T = np.eye(4)
    T[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    T[:3, 3] = list(translation)
    return T


def pose_of(numbers: Sequence[float]) -> NDArray[np.float64]:
    """Return the (4, 4) pose of 16 numbers, the rows one after the other.

    Raises
    ------
    BadRequest
        The numbers are not a rotation and translation.
    """
    T = np.array(numbers, np.float64)
    # components first: their products may overflow
    if T.shape == (16,) and np.isfinite(T).all() and np.abs(T.reshape(4, 4)[:3, :3]).max() < 2.0:
        T = T.reshape(4, 4)
        R = T[:3, :3]
        turns = np.abs(R @ R.T - np.eye(3)).max() < _NORM_TOLERANCE and np.linalg.det(R) > 0
        if turns and T[3].tolist() == [0.0, 0.0, 0.0, 1.0]:
            return T
    raise BadRequest("a pose is a rotation and a translation, 16 finite numbers")


def quaternion_of(rotation: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """Return the quaternion (x, y, z, w) of a (3, 3) rotation, w not negative.

    The largest component is computed first, which avoids loss of precision (Shepperd 1978).
    """
    r = rotation
    trace = float(r[0, 0] + r[1, 1] + r[2, 2])
    squares = [1 + 2 * float(r[i, i]) - trace for i in range(3)] + [1 + trace]
    i = int(np.argmax(squares))
    q = [0.0] * 4
    q[i] = math.sqrt(max(squares[i], 0.0)) / 2
    scale = 4 * q[i]
    if i == 3:
        q[0], q[1], q[2] = ((r[2, 1] - r[1, 2]), (r[0, 2] - r[2, 0]), (r[1, 0] - r[0, 1]))
        q[:3] = [float(v) / scale for v in q[:3]]
    else:
        j, k = (i + 1) % 3, (i + 2) % 3
        q[j] = float(r[j, i] + r[i, j]) / scale
        q[k] = float(r[k, i] + r[i, k]) / scale
        q[3] = float(r[k, j] - r[j, k]) / scale
    sign = -1.0 if q[3] < 0 else 1.0
    return sign * q[0], sign * q[1], sign * q[2], sign * q[3]


def motion_of(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the translation and rotation vector of a transform, (6,)."""
    R = T[:3, :3]
    axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine, cosine = float(np.linalg.norm(axis)) / 2.0, (float(np.trace(R)) - 1.0) / 2.0
    angle = math.atan2(sine, cosine)
    # near half a turn the axis is undefined; no vehicle turns that far between two scans
    scale = 0.5 if sine < 1e-9 else angle / (2.0 * sine)
    return np.concatenate([T[:3, 3], axis * scale])


def moved(motion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the transform, (4, 4), of a translation and a rotation vector (Rodrigues)."""
    x, y, z = motion[3:]
    angle = math.sqrt(x * x + y * y + z * z)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    T = np.eye(4)
    if angle > 1e-12:
        T[:3, :3] += math.sin(angle) / angle * K + (1 - math.cos(angle)) / angle**2 * (K @ K)
    T[:3, 3] = motion[:3]
    return T


def interpolate(
    trajectory: Trajectory, stamp_s: float, longest_s: float = math.inf
) -> NDArray[np.float64] | None:
    """Return the interpolated pose at a time.

    Parameters
    ----------
    trajectory
        Poses ordered by time.
    stamp_s
        Time, seconds.
    longest_s
        Longest time between two poses to interpolate, seconds.

    Returns
    -------
    (4, 4); None before the first or after the last pose, or where two poses are too far apart.
    """
    stamps = trajectory.stamps_s
    if not len(stamps) or stamp_s < stamps[0] or stamp_s > stamps[-1]:
        return None
    after = int(np.searchsorted(stamps, stamp_s))
    if stamps[after] == stamp_s:
        return np.asarray(trajectory.T_map_sensor[after], np.float64)
    step_s = stamps[after] - stamps[after - 1]
    if step_s > longest_s:
        return None
    a, b = trajectory.T_map_sensor[after - 1], trajectory.T_map_sensor[after]
    share = (stamp_s - stamps[after - 1]) / step_s
    return np.asarray(a @ moved(motion_of(np.linalg.inv(a) @ b) * share), np.float64)


def tum_line(stamp_s: float, T_map_sensor: NDArray[np.float64]) -> str:
    """Return one line of the format, without the newline."""
    numbers = (*T_map_sensor[:3, 3], *quaternion_of(T_map_sensor[:3, :3]))
    return " ".join([f"{stamp_s:.9f}", *(f"{float(v):.9f}" for v in numbers)])


def _lines(name: str, cause: str) -> Iterator[tuple[int, str]]:
    """Yield the lines of a text file with their numbers, without comments and empty lines.

    Raises
    ------
    MapMissing
        There is no such file.
    MapDataError
        The file cannot be read; the error has this ``cause``.
    """
    try:
        with open(name, encoding="utf-8-sig") as file:
            for number, line in enumerate(file, 1):
                if text := line.partition("#")[0].strip():
                    yield number, text
    except FileNotFoundError:
        raise MapMissing(f"there is no file {name}") from None
    except OSError as error:
        raise MapDataError(f"{name}: cannot be read: {error.strerror}", cause=cause) from error
    except UnicodeDecodeError:
        raise MapDataError(f"{name}: not a text file", cause=cause) from None


def read_trajectory(path: str | os.PathLike[str]) -> Trajectory:
    """Read a TUM file; empty lines and lines that begin with ``#`` are skipped.

    Times in milliseconds, microseconds or nanoseconds are recognised by their size or their steps.
    `Trajectory.notes` says so, and where a unit or the order of the quaternions is in doubt.

    Raises
    ------
    MapMissing
        There is no such file.
    MapDataError
        A line is not eight numbers or has no valid rotation (the message names it), or the file has no lines.
    """
    name = os.fspath(path)
    stamps: list[float] = []
    poses: list[NDArray[np.float64]] = []
    for number, text in _lines(name, "trajectory"):
        try:
            values = [float(word) for word in text.split()]
        except ValueError:
            values = []
        good = len(values) == 8 and all(abs(value) < _LARGEST for value in values)
        if not good or abs(math.hypot(*values[4:]) - 1.0) > _NORM_TOLERANCE:
            raise MapDataError(f"{name}, line {number}: not `t tx ty tz qx qy qz qw`", cause="trajectory")
        stamps.append(values[0])
        poses.append(matrix_of(values[1:4], values[4:]))
    if not stamps:
        raise MapDataError(f"{name}: no poses", cause="trajectory")
    seconds, note = _in_seconds(np.array(stamps), name)
    T_map_sensor = np.array(poses).reshape(-1, 4, 4)
    notes = (note, _order_of_quaternions(T_map_sensor, name))
    return Trajectory(seconds, T_map_sensor, tuple(text for text in notes if text))


def _in_seconds(stamps: NDArray[np.float64], name: str) -> tuple[NDArray[np.float64], str]:
    """Return times in seconds, and a note if they were in another unit or it is in doubt."""
    steps = np.diff(np.unique(stamps))
    step = float(np.median(steps)) if len(steps) else 0.0
    size = float(np.median(np.abs(stamps)))
    least, most = float(np.abs(stamps).min()), float(np.abs(stamps).max())
    if least >= _CLOCK_S[0] and most >= _APART * least:
        raise MapDataError(
            f"{name}: times of {least:.4g} and of {most:.4g} are in different units", cause="trajectory"
        )
    low, high = _CLOCK_S
    clock = [one for one in _UNITS if low <= size * one[1] < high and step * one[1] <= _SPARSE_S]
    if clock:
        unit, factor = clock[0]
    elif step <= _LONGEST_STEP or (stamps % 1.0).any():
        unit, factor = _UNITS[0]
    elif step >= _SHORTEST_STEP:
        unit, factor = _UNITS[3 if step >= 1e3 * _SHORTEST_STEP else 2]
    elif float(np.abs(stamps).min()) >= _COUNTED:
        unit, factor = _UNITS[1]
    else:
        return stamps, (
            f"times in {name} are {step:g} apart and read as seconds;"
            " if they are milliseconds or numbers of frames, no motion can be predicted: write seconds"
        )
    if factor == 1.0:
        return stamps, ""
    return stamps * factor, f"times in {name} are read as {unit}, {step * factor:.3g} s apart"


def _order_of_quaternions(T_map_sensor: NDArray[np.float64], name: str) -> str:
    """Return a note if the poses lie on their sides, but would be upright with w first in the file."""
    up = T_map_sensor[:, 2, 2]
    if np.count_nonzero(up < _LYING) * 10 < len(up):
        return ""
    # as read x y z w; with w first these four are w x y z
    quaternions = np.array([quaternion_of(T[:3, :3]) for T in T_map_sensor])
    up = 1.0 - 2.0 * (quaternions[:, 1] ** 2 + quaternions[:, 2] ** 2)
    if np.count_nonzero(up > _UPRIGHT) * 100 < 99 * len(up):
        return ""
    return (
        f"quaternions in {name} look like w first: read as qx qy qz qw, the poses lie on their sides;"
        " if so, write w last"
    )


def read_route(path: str | os.PathLike[str]) -> NDArray[np.float64]:
    """Read a route, (N, 2) float64, metres, map frame.

    Parameters
    ----------
    path
        A file with suffix ``.csv`` has a position a line, ``x,y`` and perhaps more, or a first line with
        the names of columns, including ``x`` and ``y``.  Empty lines and text after a ``#`` are skipped.
        Any other file has poses as in `read_trajectory`.

    Raises
    ------
    MapMissing
        There is no such file.
    MapDataError
        The file cannot be read or is empty, or a line lacks two finite numbers (the message names it).
    """
    name = os.fspath(path)
    if not name.lower().endswith(".csv"):
        return read_trajectory(name).T_map_sensor[:, :2, 3]
    places: list[tuple[float, float]] = []
    columns: tuple[int, int] | None = None
    for number, text in _lines(name, "route"):
        words = [word.strip() for word in text.split(",")]
        if columns is None:
            names = [word.strip('"').lower() for word in words]
            columns = (0, 1)
            if {"x", "y"} <= {*names}:
                columns = (names.index("x"), names.index("y"))
                continue
        try:
            place = float(words[columns[0]]), float(words[columns[1]])
        except (ValueError, IndexError):
            place = (np.nan, np.nan)
        if not all(abs(value) < _LARGEST for value in place):
            raise MapDataError(f"{name}, line {number}: not `x,y`", cause="route")
        places.append(place)
    if not places:
        raise MapDataError(f"{name}: no places", cause="route")
    return np.array(places)

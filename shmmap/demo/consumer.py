# SPDX-License-Identifier: Apache-2.0
"""A process that follows a vehicle and computes on the map around it.

``python -m shmmap.demo.consumer shared ENDPOINT RADIUS TASK`` follows with a `MapWindow`; ``... private MAP
RADIUS TASK`` reads the same PCD files into its own memory, as a program does without shared memory.  The rest
is the same.  The first line of stdin is the route, a list of poses; the reply is an empty line.  Each further
line is a `Step`, and the reply a `StepReport`, all in JSON.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final, TypeAlias

import msgspec
import numpy as np
from numpy.typing import NDArray

from shmmap.errors import NoAnswer, ShmmapError
from shmmap.geometry import Circle, distance_to_boxes

Points: TypeAlias = NDArray[Any]

_TIMEOUT_S: Final = 30.0
_COUNTED_METRES: Final = 20.0  # radius around the vehicle of the points that a control loop reads
_UPDATE_METRES: Final = 20.0  # distance after which a vehicle needs other cells, as in Autoware


class Pose(msgspec.Struct, frozen=True):
    """Pose of the vehicle: metres in the map frame, heading in radians counter-clockwise from x."""

    x: float
    y: float
    heading: float


class Step(msgspec.Struct, frozen=True):
    """A pose to move to, and whether to wait for its cells.

    Attributes
    ----------
    pose
        Pose of the vehicle.
    drive_on
        Whether to compute on the cells available, as a control loop must, instead of waiting for missing
        ones.
    """

    pose: Pose
    drive_on: bool


class StepReport(msgspec.Struct, frozen=True):
    """Results of one consumer at one pose.

    Attributes
    ----------
    answer
        Result of the task, as a sentence.
    follow_s
        Seconds that a control loop would have waited for the map.
    complete_s
        Seconds until all new cells were available.
    cells, points, bytes
        Cells that the consumer holds, their points, and bytes of all columns.
    current
        Whether the consumer had all cells needed; with `Step.drive_on`, those for the previous pose.
    counted
        Points that the control loop has read so far, at poses with `Step.drive_on`.
    paused_s
        Seconds since the previous reply.
    """

    answer: str
    follow_s: float
    complete_s: float
    cells: int
    points: int
    bytes: int
    current: bool
    counted: int
    paused_s: float


class _Cloud(msgspec.Struct, frozen=True):
    """One cell as input of a task.

    ``xyz`` is (N, 3), metres, map frame; ``nbytes`` counts all columns; ``top`` is the highest z.
    """

    box: tuple[float, float, float, float]
    xyz: Points
    nbytes: int
    top: float


def _survey(box: tuple[float, float, float, float], columns: Iterable[Points], xyz: Points) -> _Cloud:
    """Visit every point once, like a program that builds its own structure from a cell."""
    return _Cloud(box, xyz, sum(column.nbytes for column in columns), float(xyz[:, 2].max(initial=-math.inf)))


class _MapAround:
    """The cells around a vehicle, by id; a subclass whose `follow` waits needs no other method."""

    clouds: dict[str, _Cloud]

    def follow(self, pose: Pose) -> None:
        """Move to a pose; called from a control loop."""
        raise NotImplementedError

    def take(self) -> None:
        """Update ``clouds`` to the cells available now."""

    def wait(self) -> None:
        """Wait until all cells for the last pose are available."""

    def current(self) -> bool:
        """Whether all cells for the last pose are available."""
        return True


class _SharedMap(_MapAround):
    """Follows with shmmap, without copying points."""

    def __init__(self, endpoint: str, radius: float, route: Sequence[Pose]) -> None:
        import shmmap

        self.clouds: dict[str, _Cloud] = {}
        self._route = [(pose.x, pose.y) for pose in route]
        self._window = shmmap.MapWindow(
            endpoint, radius, update_distance=_UPDATE_METRES, name="demo consumer"
        )

    def follow(self, pose: Pose) -> None:
        """Move the window; its thread fetches the cells."""
        self._window.move_to(pose.x, pose.y, heading=pose.heading, route=self._route)

    def take(self) -> None:
        """Take the cells that the window holds."""
        before = self.clouds
        self.clouds = {
            cell.id: before.get(cell.id) or _survey(cell.box, cell.columns.values(), cell.xyz)
            for cell in self._window.cells
        }

    def wait(self) -> None:
        """Wait for the window's thread to finish."""
        deadline_s = time.monotonic() + _TIMEOUT_S
        while not self._window.wait_until_current(1.0):
            if self._window.error is not None:
                raise self._window.error
            if time.monotonic() >= deadline_s:
                raise NoAnswer(f"the window is not complete after {_TIMEOUT_S:g} s")

    def current(self) -> bool:
        """Whether the window's thread has finished the last pose."""
        return self._window.wait_until_current(0.0)


class _PrivateMap(_MapAround):
    """Follows by reading files, so that every process has a copy of its own."""

    def __init__(self, map_path: str, radius: float, route: Sequence[Pose]) -> None:
        from shmmap.origin.map_directory import open_map

        del route
        self.clouds: dict[str, _Cloud] = {}
        self._catalogue = open_map(map_path).load()
        self._radius = radius
        self._asked: Pose | None = None

    def follow(self, pose: Pose) -> None:
        """If the vehicle has moved far enough, drop cells out of reach and read new ones."""
        from shmmap.formats.cloud import read_pcd

        asked = self._asked
        if asked is not None and math.hypot(pose.x - asked.x, pose.y - asked.y) < _UPDATE_METRES:
            return
        self._asked = pose
        before, self.clouds = self.clouds, {}
        for index in self._catalogue.query(Circle(pose.x, pose.y, self._radius))[0].tolist():
            cell_id = self._catalogue.id(index)
            cloud = before.get(cell_id)
            if cloud is None:
                columns = read_pcd(self._catalogue.source(index).name).columns
                cloud = _survey(self._catalogue.box(index), columns.values(), columns["xyz"])
            self.clouds[cell_id] = cloud


def _near(clouds: Iterable[_Cloud], pose: Pose, radius: float) -> Points:
    """Return the points within ``radius`` metres of the vehicle, (N, 3), metres, map frame; a copy."""
    chosen = list(clouds)
    distances = distance_to_boxes(pose.x, pose.y, np.array([cloud.box for cloud in chosen], dtype=np.float64))
    parts = [np.empty((0, 3), dtype=np.float32)]
    for cloud, distance in zip(chosen, distances.tolist(), strict=True):
        if distance <= radius:
            squared, dy = cloud.xyz[:, 0] - np.float32(pose.x), cloud.xyz[:, 1] - np.float32(pose.y)
            squared *= squared
            dy *= dy
            squared += dy
            parts.append(cloud.xyz.compress(squared <= radius * radius, axis=0))
    return np.concatenate(parts)


def _ground_height(clouds: Iterable[_Cloud], pose: Pose) -> str:
    near = _near(clouds, pose, 3.0)
    return f"road at {np.median(near[:, 2]):.2f} m" if len(near) else "no ground"


def _density(clouds: Iterable[_Cloud], pose: Pose) -> str:
    radius = 15.0
    return f"{len(_near(clouds, pose, radius)) / (math.pi * radius**2):.0f} points per m²"


def _highest(clouds: Iterable[_Cloud], pose: Pose) -> str:
    del pose
    return f"highest point at {max((cloud.top for cloud in clouds), default=math.nan):.1f} m"


TASKS: Final[dict[str, Callable[[Iterable[_Cloud], Pose], str]]] = {
    "localization": _ground_height,
    "mapping": _density,
    "perception": _highest,
}
"""Tasks of a consumer: each returns a sentence about the map around the vehicle."""


def main(argv: list[str]) -> int:
    """Reply to poses until stdin ends."""
    kind, source, radius, task = argv
    route = msgspec.json.decode(sys.stdin.buffer.readline(), type=list[Pose])
    around: _MapAround = (_SharedMap if kind == "shared" else _PrivateMap)(source, float(radius), route)
    _write(b"")
    counted = 0
    answered_s = time.perf_counter()
    for line in sys.stdin.buffer:
        step = msgspec.json.decode(line, type=Step)
        current = not step.drive_on or around.current()
        started_s = time.perf_counter()
        around.follow(step.pose)
        followed_s = time.perf_counter()
        if not step.drive_on:
            around.wait()
        around.take()
        complete_s = time.perf_counter()
        clouds = around.clouds.values()
        answer = TASKS[task](clouds, step.pose)
        if step.drive_on:
            counted += len(_near(clouds, step.pose, _COUNTED_METRES))
        paused_s, answered_s = time.perf_counter() - answered_s, time.perf_counter()
        report = StepReport(
            answer=answer,
            follow_s=followed_s - started_s,
            complete_s=complete_s - started_s,
            cells=len(clouds),
            points=sum(len(cloud.xyz) for cloud in clouds),
            bytes=sum(cloud.nbytes for cloud in clouds),
            current=current,
            counted=counted,
            paused_s=paused_s,
        )
        _write(msgspec.json.encode(report))
    return 0


def _write(line: bytes) -> None:
    sys.stdout.buffer.write(line + b"\n")
    sys.stdout.flush()


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except ShmmapError as error:
        sys.exit(str(error))

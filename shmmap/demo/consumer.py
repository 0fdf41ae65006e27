# SPDX-License-Identifier: Apache-2.0
"""One process that follows a vehicle and computes on the map around it.

``python -m shmmap.demo.consumer shared ENDPOINT RADIUS TASK`` follows through a `MapWindow`;
``... private MAP RADIUS TASK`` reads the same PCD files into memory of its own, as a program does that
knows no shared memory.  All else is the same.  It reads one pose a line from stdin and answers with one
line on stdout, both JSON, until stdin ends; a line with a ``"route"``, the way that the poses will take, is
not answered.  A pose with ``"drive_on": true`` is answered with what is there,
complete or not, as a control loop must.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from shmmap.errors import NoAnswer
from shmmap.geometry import Circle, distance_to_boxes

__all__ = ["TASKS", "Cloud", "MapAround", "Pose", "PrivateMap", "SharedMap", "main"]

Points: TypeAlias = NDArray[Any]

_PATIENCE_S: Final = 30.0
_COUNTED_METRES: Final = 20.0  # around the vehicle: the points that a control loop reads
_UPDATE_METRES: Final = 20.0  # how far a vehicle drives before it wants other cells, as in Autoware


@dataclass(frozen=True, slots=True)
class Pose:
    """Where the vehicle is: metres in the map frame, heading in radians counter-clockwise from x."""

    x: float
    y: float
    heading: float


@dataclass(frozen=True, slots=True)
class Cloud:
    """One cell as a task sees it.

    ``xyz`` is (N, 3), metres, map frame; ``top`` the index of its highest point, -1 where it has
    none; ``nbytes`` counts all columns.
    """

    box: tuple[float, float, float, float]
    xyz: Points
    nbytes: int
    top: int

    @classmethod
    def survey(cls, box: tuple[float, float, float, float], columns: Iterable[Points], xyz: Points) -> Cloud:
        """Look at every point once, as a program does that builds something of its own from a cell."""
        top = int(np.argmax(xyz[:, 2])) if len(xyz) else -1
        return cls(box, xyz, sum(column.nbytes for column in columns), top)


class MapAround(Protocol):
    """The cells around a vehicle.

    ``route`` is the way that it will take, (x, y) each, metres, map frame.
    """

    clouds: dict[str, Cloud]
    route: Sequence[tuple[float, float]]

    def follow(self, pose: Pose) -> None:
        """What a control loop calls at every pose."""

    def complete(self) -> list[Cloud]:
        """Wait until ``clouds`` is complete for the last pose; returns the cells that are new."""

    def take(self) -> None:
        """Let ``clouds`` be what is there now."""

    def current(self) -> bool:
        """Whether all that the last pose needs is there."""


class SharedMap:
    """Follows through shmmap: the points stay where the daemon put them.

    Parameters
    ----------
    endpoint
        Socket of the daemon.
    radius
        Of the window, metres.
    """

    def __init__(self, endpoint: str, radius: float) -> None:
        import shmmap

        self.clouds: dict[str, Cloud] = {}
        self.route: Sequence[tuple[float, float]] = ()
        self._window = shmmap.MapWindow(
            endpoint, radius, update_distance=_UPDATE_METRES, name="demo consumer"
        )

    def follow(self, pose: Pose) -> None:
        """Tell the window where the vehicle is; its thread does the rest."""
        self._window.move_to(pose.x, pose.y, heading=pose.heading, route=self.route)

    def complete(self) -> list[Cloud]:
        """Wait for the window's thread; returns the cells that are new."""
        deadline_s = time.monotonic() + _PATIENCE_S
        while not self._window.wait_until_current(1.0):
            if self._window.error is not None:
                raise self._window.error
            if time.monotonic() >= deadline_s:
                raise NoAnswer(f"the window is not complete after {_PATIENCE_S:g} s")
        return self._look()

    def take(self) -> None:
        """Look at what the window holds, whatever its thread is doing."""
        self._look()

    def current(self) -> bool:
        """Whether the window's thread is done with the last pose."""
        return self._window.wait_until_current(0.0)

    def _look(self) -> list[Cloud]:
        before, self.clouds = self.clouds, {}
        new = []
        for cell in self._window.cells:
            cloud = before.get(cell.id)
            if cloud is None:
                cloud = Cloud.survey(cell.box, cell.columns.values(), cell.xyz)
                new.append(cloud)
            self.clouds[cell.id] = cloud
        return new


class PrivateMap:
    """Follows by reading files: every process that does so has a copy of its own.

    Parameters
    ----------
    map_path
        The map's directory.
    radius
        Of the window, metres.
    """

    def __init__(self, map_path: str, radius: float) -> None:
        from shmmap.origin.map_directory import open_map

        self.clouds: dict[str, Cloud] = {}
        self.route: Sequence[tuple[float, float]] = ()
        self._new: list[Cloud] = []
        self._catalogue = open_map(map_path).load()
        self._radius = radius
        self._asked: Pose | None = None

    def follow(self, pose: Pose) -> None:
        """Drop what is out of reach and read what is new, where the vehicle has come far enough for that."""
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
                cloud = Cloud.survey(self._catalogue.box(index), columns.values(), columns["xyz"])
                self._new.append(cloud)
            self.clouds[cell_id] = cloud

    def complete(self) -> list[Cloud]:
        """Return the cells that are new."""
        new, self._new = self._new, []
        return new

    def take(self) -> None:
        """All is there: `follow` has read it."""
        self._new = []

    def current(self) -> bool:
        """Return True: `follow` waits."""
        return True


def _near(clouds: Iterable[Cloud], pose: Pose, radius: float) -> Points:
    """Points within ``radius`` metres of the vehicle, (N, 3), metres, map frame; a copy."""
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


def _ground_height(clouds: dict[str, Cloud], pose: Pose) -> str:
    near = _near(clouds.values(), pose, 3.0)
    return f"road at {np.median(near[:, 2]):.2f} m" if len(near) else "no ground"


def _free_road(clouds: dict[str, Cloud], pose: Pose) -> str:
    reach, half_width = 25.0, 1.2
    near = _near(clouds.values(), pose, reach)
    aside = near[:, 1] - np.float32(pose.y)
    aside *= math.cos(pose.heading)
    aside -= (near[:, 0] - np.float32(pose.x)) * np.float32(math.sin(pose.heading))
    strip = near.compress(np.abs(aside, out=aside) < half_width, axis=0)
    ahead = (strip[:, 0] - pose.x) * math.cos(pose.heading) + (strip[:, 1] - pose.y) * math.sin(pose.heading)
    road = strip[(ahead > 0.0) & (ahead < 3.0), 2]
    ground = float(np.median(road)) if len(road) else 0.0
    raised = (ahead > 0.0) & (strip[:, 2] > ground + 1.0) & (strip[:, 2] < ground + 2.5)
    return f"road free for {ahead[raised].min(initial=reach):.0f} m"


def _landmark(clouds: dict[str, Cloud], pose: Pose) -> str:
    tops = np.array([cloud.xyz[cloud.top] for cloud in clouds.values() if cloud.top >= 0])
    if not len(tops):
        return "no landmark"
    x, y, z = tops[np.argmax(tops[:, 2])].tolist()
    return f"highest point at {z:.1f} m, {math.hypot(x - pose.x, y - pose.y):.0f} m away"


def _density(clouds: dict[str, Cloud], pose: Pose) -> str:
    radius = 15.0
    return f"{len(_near(clouds.values(), pose, radius)) / (math.pi * radius**2):.0f} points per m²"


TASKS: Final[dict[str, Callable[[dict[str, Cloud], Pose], str]]] = {
    "localization": _ground_height,
    "planning": _free_road,
    "perception": _landmark,
    "mapping": _density,
}
"""What a consumer may compute at every pose: a sentence about the map around the vehicle."""


def main(argv: list[str]) -> int:
    """Answer poses until stdin ends."""
    kind, source, radius, task = argv
    around: MapAround = (SharedMap if kind == "shared" else PrivateMap)(source, float(radius))
    compute = TASKS[task]
    counted = 0
    answered_s = time.perf_counter()
    _say({"ready": True})
    for line in sys.stdin:
        order = json.loads(line)
        if "route" in order:
            around.route = [(x, y) for x, y in order["route"]]
            continue
        drive_on = order.pop("drive_on")
        pose = Pose(**order)
        current = not drive_on or around.current()
        started_s = time.perf_counter()
        around.follow(pose)
        followed_s = time.perf_counter()
        new = []
        if drive_on:
            around.take()
        else:
            new = around.complete()
        complete_s = time.perf_counter()
        answer = compute(around.clouds, pose)
        if drive_on:
            counted += len(_near(around.clouds.values(), pose, _COUNTED_METRES))
        paused_s, answered_s = time.perf_counter() - answered_s, time.perf_counter()
        _say(
            {
                "answer": answer,
                "follow_s": followed_s - started_s,
                "complete_s": complete_s - started_s,
                "new": len(new),
                "new_bytes": sum(cloud.nbytes for cloud in new),
                "cells": len(around.clouds),
                "points": sum(len(cloud.xyz) for cloud in around.clouds.values()),
                "bytes": sum(cloud.nbytes for cloud in around.clouds.values()),
                "current": current,
                "counted": counted,
                "paused_s": paused_s,
            }
        )
    return 0


def _say(message: dict[str, object]) -> None:
    sys.stdout.write(json.dumps(message) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

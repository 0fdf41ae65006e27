# SPDX-License-Identifier: Apache-2.0
"""The demonstration's town: how large it may be on this machine, built as a divided map, and drawn."""

from __future__ import annotations

import contextlib
import math
import os
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from shmmap.demo.consumer import Pose
from shmmap.demo.progress import Progress
from shmmap.dividing.map_writer import MapWriter
from shmmap.errors import ConfigError
from shmmap.simulation.height_image import HeightImage
from shmmap.simulation.town import Town
from shmmap.simulation.town_ground import BLOCK_METRES

__all__ = ["DemoSettings", "TownMap", "build_town", "fit", "free_bytes"]

_POINT_BYTES: Final = 16  # x, y, z and intensity as float32
_POINTS_PER_GROUND_POINT: Final = 1.65  # roofs, walls and leaves add to the ground
_CELL_METRES: Final = 20.0
_SMALLEST_DENSITY: Final = 2.0
_FILL: Final = 0.8  # of what is free, at most
_STATISTICS_BYTES: Final = 256 << 10
_CELL_OVERHEAD_BYTES: Final = 12 << 10  # its header, and columns rounded up to pages
_SPARE: Final = 1.25  # budget over window
_PROCESS_BYTES: Final = 30 << 20  # of a consumer without its points


@dataclass(frozen=True, slots=True)
class DemoSettings:
    """What is built and driven.

    Attributes
    ----------
    blocks
        Size of the town in blocks of 80 m.
    density
        Points per square metre of ground; less where shared memory is scarce.
    radius
        Of every process's window, metres.
    length, step
        Of the drive that is measured, metres.
    onward
        How far the last drive continues, a metre at a time, while the daemon is killed and starts again.
    localized
        Length of the drive of the localization, metres.
    pace_s
        Least time per step.
    counts
        How many processes drive together, one drive after the other, ascending.
    seed
        Which town.
    """

    blocks: tuple[int, int] = (5, 4)
    density: float = 100.0
    radius: float = 110.0
    length: float = 250.0
    step: float = 5.0
    onward: int = 50
    localized: float = 80.0
    pace_s: float = 0.04
    counts: tuple[int, ...] = (1, 8)
    seed: int = 4


@dataclass(frozen=True, slots=True)
class TownMap:
    """The map on disk, a picture of it, and the route through it, which goes on with ``onward``."""

    path: str
    cells: int
    points: int
    file_bytes: int
    boxes: tuple[tuple[float, float, float, float], ...]
    bounds: tuple[float, float, float, float]
    picture_png: bytes
    route: tuple[Pose, ...]
    onward: tuple[Pose, ...]
    build_s: float


def free_bytes(directory: str) -> int:
    """Return how much more fits on a file system."""
    state = os.statvfs(directory)
    return state.f_bavail * state.f_frsize


def free_memory_bytes() -> int:
    """Return how much memory processes can still have, a container's limit respected."""
    fields = dict(line.split(":") for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines())
    free = int(fields["MemAvailable"].split()[0]) << 10
    group = Path("/sys/fs/cgroup")  # in a container: its own
    with contextlib.suppress(OSError, ValueError):  # no limit is the word "max", or no file
        limit = int((group / "memory.max").read_text(encoding="ascii"))
        free = min(free, limit - int((group / "memory.current").read_text(encoding="ascii")))
    return free


def fit(
    settings: DemoSettings, *, shm_bytes: int, disk_bytes: int, memory_bytes: int, copies: int
) -> tuple[DemoSettings, int]:
    """Choose a budget of shared memory, and thin the town out where there is little room.

    The budget holds the largest window and a little more, so that cells stay for a while and are evicted
    in the end.  A container has 64 MB of shared memory by default.

    Parameters
    ----------
    shm_bytes, disk_bytes, memory_bytes
        What is free.
    copies
        Private copies of the window that have to fit in memory at once, each in its own process.

    Returns
    -------
    settings
        With the density that fits.
    budget_bytes
        For the daemon.

    Raises
    ------
    ConfigError
        There is too little room for any town.
    """
    per_metre2 = _POINTS_PER_GROUND_POINT * _POINT_BYTES
    window_metres2 = math.pi * (settings.radius + _CELL_METRES / 2) ** 2
    town_metres2 = math.prod(settings.blocks) * BLOCK_METRES**2
    overhead_bytes = _STATISTICS_BYTES + window_metres2 / _CELL_METRES**2 * _CELL_OVERHEAD_BYTES
    density = min(
        settings.density,
        (_FILL * shm_bytes / _SPARE - overhead_bytes) / (window_metres2 * per_metre2),
        _FILL * disk_bytes / (town_metres2 * per_metre2),
        (_FILL * memory_bytes / copies - _PROCESS_BYTES) / (window_metres2 * per_metre2),
    )
    if density < _SMALLEST_DENSITY:
        raise ConfigError(
            f"too little room: {shm_bytes >> 20} MiB of shared memory, {disk_bytes >> 20} MiB of disk,"
            f" {memory_bytes >> 20} MiB of memory",
            hint="a container gets more shared memory with `--shm-size=512m`; TMPDIR names another disk",
        )
    budget_bytes = _SPARE * (window_metres2 * per_metre2 * density + overhead_bytes)
    return replace(settings, density=density), int(budget_bytes)


def build_town(settings: DemoSettings, map_dir: str, progress: Progress) -> TownMap:
    """Write the town as a divided map, block by block, and draw it from above."""
    started_s = time.perf_counter()
    town = Town(seed=settings.seed, blocks=settings.blocks, density=settings.density)
    image = HeightImage(town.bounds)
    with MapWriter(map_dir, prefix="town", durable=False) as writer:
        progress.stage("Building a town", settings.blocks[0] * settings.blocks[1])
        for columns in town.tiles():
            writer.add(columns)
            image.add(columns["xyz"], columns["intensity"])
            progress.step()
        written = writer.finish()
    measured = int(settings.length / settings.step) * settings.step
    poses = town.route(length=settings.length, step=settings.step)
    onward = town.route(length=measured + settings.onward, step=1.0)[int(measured) + 1 :]
    files = list(Path(map_dir, "pointcloud_map.pcd").iterdir())
    return TownMap(
        path=map_dir,
        cells=written.cells,
        points=written.points,
        file_bytes=sum(file.stat().st_size for file in files),
        boxes=tuple(_cell_box(file) for file in files),
        bounds=town.bounds,
        picture_png=image.png(town.ground_height),
        route=tuple(Pose(*pose) for pose in poses.tolist()),
        onward=tuple(Pose(*pose) for pose in onward.tolist()),
        build_s=time.perf_counter() - started_s,
    )


def _cell_box(file: Path) -> tuple[float, float, float, float]:
    x, y = (float(part) for part in file.stem.split("_")[-2:])
    return x, y, x + _CELL_METRES, y + _CELL_METRES

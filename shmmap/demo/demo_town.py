# SPDX-License-Identifier: Apache-2.0
"""The demonstration's town: fit its size to this machine, build it as a divided map, and draw it."""

from __future__ import annotations

import math
import os
import time
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Final

from shmmap.demo.consumer import Pose
from shmmap.demo.program import Progress
from shmmap.dividing.map_writer import MapWriter
from shmmap.errors import ConfigError
from shmmap.formats.png import png_bytes
from shmmap.geometry import Box
from shmmap.mounts import control_groups, group_values
from shmmap.simulation.town import Town
from shmmap.simulation.town_surfaces import BLOCK_METRES
from shmmap.viewing.page import View, backdrop, draw, looking_from
from shmmap.viewing.sources import open_files

_POINT_BYTES: Final = 16  # x, y, z and intensity as float32
_POINTS_PER_GROUND_POINT: Final = 1.65  # surface per ground area: roofs, walls and leaves count, too
_CELL_METRES: Final = 20.0
_SMALLEST_DENSITY: Final = 2.0
_FILL: Final = 0.8  # share of the free memory, at most
_STATISTICS_BYTES: Final = 256 << 10
_CELL_OVERHEAD_BYTES: Final = 12 << 10  # bytes of its header, and of columns rounded up to pages
_SPARE: Final = 1.25  # ratio of budget to window
_BACKDROP_PX: Final = 960
PICTURE_FROM: Final = "south-west"
"""Where one looks from in the oblique picture, as in ``shmmap view --from``."""
_PROCESS_BYTES: Final = 30 << 20  # bytes of a consumer without its points


@dataclass(frozen=True, slots=True)
class DemoSettings:
    """Settings of town and drive.

    Attributes
    ----------
    blocks
        Size of the town in blocks of 80 m.
    density
        Points per square metre of ground; reduced if shared memory is scarce.
    radius
        Radius of every process's window, metres.
    length, step
        Length of the measured drive, and distance between its poses, metres.
    onward
        Distance that the last drive continues, a metre at a time, while the daemon is killed and restarted,
        metres.
    localized
        Length of the localized drive, metres.
    pace_s
        Minimum seconds per step.
    counts
        Number of processes in each drive, ascending.
    seed
        Random seed of the town.
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
    """The map on disk, pictures of it from above and obliquely, and the route, which ``onward`` continues."""

    path: str
    cells: int
    points: int
    file_bytes: int
    boxes: tuple[tuple[float, float, float, float], ...]
    bounds: tuple[float, float, float, float]
    backdrop_png: bytes
    picture_png: bytes
    route: tuple[Pose, ...]
    onward: tuple[Pose, ...]
    build_s: float


def free_bytes(directory: str) -> int:
    """Return the free bytes on a file system."""
    state = os.statvfs(directory)
    return state.f_bavail * state.f_frsize


def free_memory_bytes() -> int:
    """Return the memory that processes can still allocate, within a container's limit."""
    fields = dict(line.split(":") for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines())
    free = int(fields["MemAvailable"].split()[0]) << 10
    for group in chain.from_iterable(control_groups("memory")):
        for limit in group_values([group], "memory.max"):
            free = min(free, limit - sum(group_values([group], "memory.current")))
    return free


def fit(
    settings: DemoSettings, *, shm_bytes: int, disk_bytes: int, memory_bytes: int, copies: int
) -> tuple[DemoSettings, int]:
    """Choose a budget of shared memory, and reduce the town's density if memory or disk is scarce.

    The budget is a little larger than the largest window, so that cells stay for a while before eviction.  A
    container has 64 MB of shared memory by default.

    Parameters
    ----------
    shm_bytes, disk_bytes, memory_bytes
        Free bytes of each.
    copies
        Private copies of the window that must fit in memory at once, each in its own process.

    Returns
    -------
    settings
        Settings with a density that fits.
    budget_bytes
        Budget of the daemon.

    Raises
    ------
    ConfigError
        Memory or disk is too small for any town.
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
    """Write the town as a divided map, block by block, and draw it."""
    started_s = time.perf_counter()
    town = Town(seed=settings.seed, blocks=settings.blocks, density=settings.density)
    with MapWriter(map_dir, prefix="town", durable=False) as writer:
        progress.stage("Building a town", settings.blocks[0] * settings.blocks[1])
        for columns in town.tiles():
            writer.add(columns)
            progress.step()
        written = writer.finish()
    progress.stage("Drawing it", 1)
    with open_files([map_dir]) as source:
        source.title = "a generated town"  # the directory may be gone when the picture is looked at
        backdrop_png = backdrop(source.blocks(Box(*town.bounds), ""), town.bounds, _BACKDROP_PX) or b""
        drawn = draw(source, View(town.bounds, azimuth=looking_from(PICTURE_FROM)))
    progress.step()
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
        backdrop_png=backdrop_png,
        picture_png=png_bytes(drawn.pixels) if drawn is not None else b"",
        route=tuple(Pose(*pose) for pose in poses.tolist()),
        onward=tuple(Pose(*pose) for pose in onward.tolist()),
        build_s=time.perf_counter() - started_s,
    )


def _cell_box(file: Path) -> tuple[float, float, float, float]:
    x, y = (float(part) for part in file.stem.split("_")[-2:])
    return x, y, x + _CELL_METRES, y + _CELL_METRES

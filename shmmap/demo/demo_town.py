# SPDX-License-Identifier: Apache-2.0
"""The demonstration's town: fit its size to this machine, build it as a divided map, and draw it."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from shmmap.demo.consumer import Pose
from shmmap.demo.program import Progress
from shmmap.dividing.map_writer import MapWriter
from shmmap.errors import ConfigError
from shmmap.formats.png import png_bytes
from shmmap.mounts import control_groups, group_values
from shmmap.simulation.town import Town
from shmmap.simulation.town_surfaces import BLOCK_METRES

__all__ = ["DemoSettings", "HeightImage", "TownMap", "build_town", "fit", "free_bytes"]

_POINT_BYTES: Final = 16  # x, y, z and intensity as float32
_POINTS_PER_GROUND_POINT: Final = 1.65  # surface per ground area: roofs, walls and leaves count, too
_CELL_METRES: Final = 20.0
_SMALLEST_DENSITY: Final = 2.0
_FILL: Final = 0.8  # share of the free memory, at most
_STATISTICS_BYTES: Final = 256 << 10
_CELL_OVERHEAD_BYTES: Final = 12 << 10  # bytes of its header, and of columns rounded up to pages
_SPARE: Final = 1.25  # ratio of budget to window
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
    """The map on disk, a picture of it, and the route through it, which ``onward`` continues."""

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


Ground: TypeAlias = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[Any]]

_NOTHING: Final = 0  # palette entry of pixels without a point
_GROUND_LEVELS: Final = 16  # palette entries for the ground, from dark asphalt to light paint
_HEIGHT_LEVELS: Final = 100  # palette entries each for plants and for buildings, from low to high
_GROUND_METRES: Final = 0.3  # metres; lower points belong to the ground
_LOW_METRES, _HIGH_METRES = 0.3, 25.0
_PLANT_INTENSITY: Final = 52.0  # the town's leaves reflect more than its roofs

# position on the scale (0 to 1) and its colour; colours in between are interpolated
_GROUND_COLOURS: Final = (
    (0.0, (176, 176, 178)),
    (0.25, (214, 211, 205)),
    (0.6, (233, 230, 222)),
    (1.0, (255, 255, 255)),
)
_PLANT_COLOURS: Final = ((0.0, (190, 208, 168)), (0.35, (142, 178, 120)), (1.0, (78, 122, 84)))
_BUILDING_COLOURS: Final = (
    (0.0, (206, 178, 150)),
    (0.4, (190, 142, 104)),
    (0.7, (150, 92, 72)),
    (1.0, (92, 52, 52)),
)


class HeightImage:
    """Keeps height and intensity of the highest point of every pixel.

    Parameters
    ----------
    box
        Area of the image: (min_x, min_y, max_x, max_y), metres, map frame.
    pixel
        Side of a pixel, metres.
    """

    def __init__(self, box: tuple[float, float, float, float], pixel: float = 0.5) -> None:
        self.box = box
        self._pixel = pixel
        self._columns = max(1, round((box[2] - box[0]) / pixel))
        self._rows = max(1, round((box[3] - box[1]) / pixel))
        self._top = np.full(self._rows * self._columns, -np.inf, dtype=np.float32)
        self._intensity = np.zeros(self._rows * self._columns, dtype=np.float32)

    def add(self, xyz: NDArray[Any], intensity: NDArray[Any]) -> None:
        """Add points: (N, 3), metres, map frame, and (N,), 0 to 255; those outside the box are ignored."""
        column = np.floor((xyz[:, 0] - self.box[0]) / self._pixel).astype(np.intp)
        row = np.floor((self.box[3] - xyz[:, 1]) / self._pixel).astype(np.intp)
        inside = (column >= 0) & (column < self._columns) & (row >= 0) & (row < self._rows)
        pixel, z = row[inside] * self._columns + column[inside], xyz[inside, 2].astype(np.float32)
        np.maximum.at(self._top, pixel, z)
        highest = z >= self._top[pixel]
        self._intensity[pixel[highest]] = intensity[inside][highest]

    def png(self, ground: Ground) -> bytes:
        """Return the image, north up.

        Parameters
        ----------
        ground
            Function that returns the height of the ground at (x, y), arrays of metres.
        """
        x = self.box[0] + (np.arange(self._columns) + 0.5) * self._pixel
        y = self.box[3] - (np.arange(self._rows) + 0.5) * self._pixel
        above = self._top - ground(np.tile(x, self._rows), np.repeat(y, self._columns))
        # a square root spreads low heights (hedges) over as many colours as high ones (towers)
        scale = np.sqrt(np.clip((above - _LOW_METRES) / (_HIGH_METRES - _LOW_METRES), 0.0, 1.0))
        height = (scale * (_HEIGHT_LEVELS - 1)).astype(np.uint8)
        shade = (np.clip(self._intensity / 128.0, 0.0, 1.0) * (_GROUND_LEVELS - 1)).astype(np.uint8)
        plants = 1 + _GROUND_LEVELS
        raised = np.where(
            self._intensity > _PLANT_INTENSITY, plants + height, plants + _HEIGHT_LEVELS + height
        )
        seen = np.where(above < _GROUND_METRES, 1 + shade, raised)
        pixels = np.where(np.isfinite(self._top), seen, _NOTHING).astype(np.uint8)
        palette = b"\xff\xff\xff" + b"".join(
            (
                _mixed(_GROUND_COLOURS, _GROUND_LEVELS),
                _mixed(_PLANT_COLOURS, _HEIGHT_LEVELS),
                _mixed(_BUILDING_COLOURS, _HEIGHT_LEVELS),
            )
        )
        return png_bytes(pixels.reshape(self._rows, self._columns), palette)


def _mixed(stops: Sequence[tuple[float, tuple[int, int, int]]], levels: int) -> bytes:
    at = np.linspace(0.0, 1.0, levels)
    channels = [np.interp(at, [place for place, _ in stops], [rgb[i] for _, rgb in stops]) for i in range(3)]
    return bytes(np.stack(channels, axis=1).round().astype(np.uint8).tobytes())

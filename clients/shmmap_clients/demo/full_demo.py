# SPDX-License-Identifier: Apache-2.0
"""The demonstration with the real programs: a vehicle localizes, sees what moves, and maps the ground.

A LiDAR is simulated in the generated town, among moving cars and people; localization, compare filter and
elevation map run beside one another on one daemon.  It leaves nothing behind.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.demo.daemon_process import DaemonProcess
from shmmap.demo.demo_town import DemoSettings, Progress, TownMap, build_town, fit, free_bytes
from shmmap.demo.interrupts import scratch_directory
from shmmap.segment.directory import DEFAULT_SHM_DIR
from shmmap.simulation.lidar import Lidar
from shmmap.simulation.town import Town
from shmmap.simulation.town_ground import BLOCK_METRES
from shmmap.simulation.town_traffic import Traffic
from shmmap_clients.demo.three_programs import ThreePrograms, run_three_programs
from shmmap_clients.scans.scan_sequence import Scan
from shmmap_clients.scans.trajectory import matrix_of

__all__ = ["FullDemoResult", "run_full_demo"]

_STEP_METRES: Final = 2.0
_SPEED: Final = 10.0  # metres per second
_SENSOR_METRES: Final = 1.8  # above the ground
_SEEN_METRES: Final = 60.0
_SURFACE_DENSITY: Final = 40.0  # of what the LiDAR sees, points per square metre
_WINDOW_METRES: Final = 80.0
_BLOCKS: Final = (3, 3)
_LENGTH_METRES: Final = 160.0


@dataclass(slots=True)
class FullDemoResult:
    """The town, the drive, and its picture as the compare filter drew it."""

    town: TownMap
    programs: ThreePrograms
    picture_svg: str


def _simulated_drive(town: Town, *, length: float, seed: int = 0) -> Iterator[Scan]:
    """Scans with poses of a drive through a town, every two metres, among moving cars and people.

    Columns: ``xyz``, ``ring`` (uint8), and ``moving`` (uint8), 1 for a point of what moves.
    """
    route = town.route(length=length, step=_STEP_METRES)
    traffic = Traffic(town, town.route(length=length + _SEEN_METRES, step=_STEP_METRES), seed=seed)
    lidar = Lidar(rings=40, azimuth_deg=0.4, farthest=_SEEN_METRES)
    # the same surfaces as the map's, but other points of them
    seen = Town(seed=town.seed, blocks=town.blocks, origin=town.origin, density=_SURFACE_DENSITY)
    tile = lru_cache(maxsize=9)(lambda bx, by: seen.tile(bx, by)["xyz"])
    rng = np.random.Generator(np.random.PCG64([seed, 11]))
    for number in range(len(route)):
        x, y, heading = (float(value) for value in route[number])
        stamp_s = number * _STEP_METRES / _SPEED
        z = float(town.ground_height(np.array(x), np.array(y))) + _SENSOR_METRES
        T = matrix_of((x, y, z), (0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2)))
        near = [tile(bx, by) for bx, by in _tiles(town, x, y)]
        parts: list[NDArray[np.floating]] = [
            part[(np.abs(part[:, :2] - (x, y)) < _SEEN_METRES).all(axis=1)] for part in near
        ]
        still = sum(len(part) for part in parts)
        returns = lidar.scan(np.concatenate([*parts, traffic.points(stamp_s)]), T, rng)
        moving = (returns.source >= still).astype(np.uint8)
        columns: dict[str, NDArray[Any]] = {"xyz": returns.xyz, "ring": returns.ring, "moving": moving}
        yield Scan(f"scan_{number:04}", stamp_s, columns, T)


def _tiles(town: Town, x: float, y: float) -> list[tuple[int, int]]:
    """Blocks that the LiDAR sees from a place."""
    spans = [
        range(
            max(0, math.floor((at - _SEEN_METRES - start) / BLOCK_METRES)),
            min(count, math.floor((at + _SEEN_METRES - start) / BLOCK_METRES) + 1),
        )
        for at, start, count in zip((x, y), town.origin, town.blocks, strict=True)
    ]
    return [(bx, by) for by in spans[1] for bx in spans[0]]


def run_full_demo(
    settings: DemoSettings,
    progress: Progress,
    *,
    map_dir: str | None = None,
    length: float = _LENGTH_METRES,
) -> FullDemoResult:
    """Build a town, drive through it with the three programs, measure, clean up.

    Parameters
    ----------
    map_dir
        Where the map is built and stays; by default in a temporary directory that is removed.
    length
        Of the drive, metres.

    Raises
    ------
    ConfigError
        There is not enough shared memory.
    BadRequest
        ``map_dir`` exists and is not empty.
    InternalError
        A program failed.
    """
    with contextlib.ExitStack() as stack:
        scratch = Path(stack.enter_context(scratch_directory("shmmap-demo-")))
        map_dir = map_dir or str(scratch / "map")
        parent = Path(map_dir).absolute().parent
        parent.mkdir(parents=True, exist_ok=True)
        settings, budget_bytes = fit(
            replace(settings, blocks=_BLOCKS),
            shm_bytes=free_bytes(DEFAULT_SHM_DIR),
            disk_bytes=free_bytes(str(parent)),
        )
        town_map = build_town(settings, map_dir, progress)
        town = Town(seed=settings.seed, blocks=settings.blocks, density=settings.density)
        # sockets under /tmp whatever TMPDIR says: a socket's path holds 107 bytes
        work = Path(stack.enter_context(scratch_directory("shmmap-demo-", "/tmp")))  # noqa: S108
        options = ["--budget", str(budget_bytes), "--workers", "2", "--cache-dir", str(scratch / "cache")]
        daemon = stack.enter_context(DaemonProcess(map_dir, options=options))
        route = town.route(length=length, step=_STEP_METRES)
        progress.stage("Driving: localization, compare filter and elevation map on one copy", len(route))
        tell: Callable[[ThreePrograms], None] = lambda _: progress.step()  # noqa: E731
        window = ["--update-distance", "10"]
        programs = run_three_programs(
            daemon.endpoint, daemon.shm_dir, daemon.instance,
            _simulated_drive(town, length=length), _poses(town, route), work,
            ndt=["--map-radius", str(_WINDOW_METRES), "--lidar-radius", str(_SEEN_METRES), *window],
            compare=["--mode", "distance", "--map-radius", str(_WINDOW_METRES), *window],
            after_scan=tell,
        )  # fmt: skip
        picture = (work / "compare.svg").read_text(encoding="utf-8")
    return FullDemoResult(town_map, programs, picture)


def _poses(town: Town, route: NDArray[np.float64]) -> Iterator[tuple[float, NDArray[np.float64]]]:
    heights = town.ground_height(route[:, 0], route[:, 1]) + _SENSOR_METRES
    for number, ((x, y, heading), z) in enumerate(zip(route.tolist(), heights.tolist(), strict=True)):
        quaternion = (0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2))
        yield number * _STEP_METRES / _SPEED, matrix_of((x, y, z), quaternion)

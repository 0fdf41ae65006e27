# SPDX-License-Identifier: Apache-2.0
"""A drive that is mapped into a live map with too little memory, while daemon and mapping program are killed.

The way is a round through the town, and a part of it once more: chunks are given up, and come back.  In the
end the map's files are compared with a map without bounds of the same scans.
"""

from __future__ import annotations

import contextlib
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from shmmap.demo.demo_town import Progress
from shmmap.demo.live_mapper import FILTER
from shmmap.demo.live_mapping import PATIENCE_S, Kills, Mapping, Watch, map_all
from shmmap.demo.program import Program
from shmmap.demo.unbounded_map import UnboundedMap
from shmmap.errors import InternalError
from shmmap.processes.end_with_parent import with_us
from shmmap.processes.interrupts import scratch_directory
from shmmap.simulation.lidar import Lidar
from shmmap.simulation.lidar_drive import LidarDrive
from shmmap.simulation.town import Town
from shmmap.testing.daemon_process import DaemonProcess

__all__ = ["LiveDriveResult", "LiveDriveSettings", "run_live_drive"]

_MAP: Final = "town"
_LIDAR: Final = Lidar(rings=32, highest_deg=12.0, azimuth_deg=0.6, farthest=25.0)
_SETTINGS: Final = """\
[live.{name}]
path = {path}
resolution = {resolution!r}
radius = 2
linger_s = 0.5
"""


@dataclass(frozen=True, slots=True)
class LiveDriveSettings:
    """What is driven and mapped.

    Attributes
    ----------
    blocks, seed
        Of the town; one of 3 x 3 blocks has a round of 320 m.
    length, step
        Of the drive, and between scans, metres.
    lidar, density
        What takes the scans, and points per square metre that it sees.
    resolution
        Edge of a voxel, metres.
    budget_bytes
        Memory that chunks may take.
    """

    blocks: tuple[int, int] = (3, 3)
    seed: int = 4
    length: float = 450.0
    step: float = 3.0
    lidar: Lidar = _LIDAR
    density: float = 15.0
    resolution: float = 0.2
    budget_bytes: int = 8 << 20


@dataclass(frozen=True, slots=True)
class LiveDriveResult:
    """What came of it.

    Attributes
    ----------
    scans, points, length_m
        Of the drive.
    chunks, file_bytes
        Of the map on disk.
    given_up, came_back
        How often a chunk of it left memory, and how often one came into memory again.
    budget_bytes, most_bytes
        Memory that chunks may take, and the most that those in service took.
    active, active_bytes
        Known voxels in memory at the end of the drive, and what their chunks take there.
    kills
        Of the daemon and of the mapping program.
    mapping_s
        Time from the first scan to the last, with both kills.
    voxels, differing
        Of the map on disk and of the one without bounds.
    picture_svg
        The map at the end of the drive, before all of it was saved.
    """

    scans: int
    points: int
    length_m: float
    chunks: int
    file_bytes: int
    given_up: int
    came_back: int
    budget_bytes: int
    most_bytes: int
    active: int
    active_bytes: int
    kills: Kills
    mapping_s: float
    voxels: int
    differing: int
    picture_svg: str


def run_live_drive(settings: LiveDriveSettings, progress: Progress) -> LiveDriveResult:
    """Drive, map, kill, compare, clean up.

    Raises
    ------
    PackageMissing
        numba is not installed.
    InternalError
        A process failed.
    """
    import shmmap

    with contextlib.ExitStack() as stack:
        scratch = Path(stack.enter_context(scratch_directory("shmmap-demo-")))
        map_dir = scratch / "map"
        config = scratch / "live.toml"
        config.write_text(
            _SETTINGS.format(name=_MAP, path=json.dumps(str(map_dir)), resolution=settings.resolution),
            encoding="utf-8",
        )
        budgets = ["--budget", "16M", "--live-budget", str(settings.budget_bytes)]
        daemon = stack.push(DaemonProcess("", "--config", str(config), *budgets, command=with_us()))
        daemon.launch()  # it starts while scans are made
        drive = _Drive(settings, scratch, progress)
        daemon.wait_ready(PATIENCE_S)
        client = stack.enter_context(shmmap.connect(daemon.endpoint, name="demo"))
        live = client.live(_MAP)
        watch = Watch(live)
        mapping = stack.enter_context(Mapping(_MAP, daemon.endpoint, drive.scans_dir, scratch))
        began_s = time.perf_counter()
        kills = map_all(len(drive.path), mapping, watch, daemon, progress)
        mapping_s = time.perf_counter() - began_s
        progress.stage("Drawing the map, saving it, comparing it with one that had no bounds", 3)
        x, y, z = drive.path[-1]
        live.move_to(x, y, z)  # the vehicle stays where it is, its program ends
        mapping.finish()
        watch.look()
        usage = live.status()
        picture_svg = _draw(daemon.endpoint, drive, scratch)
        progress.step()
        live.save()
        files = live.status()
        daemon.stop()
        progress.step()
        voxels, differing = drive.unbounded.compare(str(map_dir))
        progress.step()
        return LiveDriveResult(
            scans=len(drive.path), points=drive.points, length_m=settings.length, chunks=files.files,
            file_bytes=files.file_bytes, given_up=watch.given_up, came_back=watch.came_back,
            budget_bytes=settings.budget_bytes, most_bytes=watch.most_bytes, active=usage.active,
            active_bytes=usage.bytes, kills=kills, mapping_s=mapping_s, voxels=voxels, differing=differing,
            picture_svg=picture_svg,
        )  # fmt: skip


class _Drive:
    """Scans in files, where the sensor was, and the map without bounds."""

    def __init__(self, settings: LiveDriveSettings, scratch: Path, progress: Progress) -> None:
        town = Town(seed=settings.seed, blocks=settings.blocks)
        drive = LidarDrive(
            town, settings.length, settings.step, lidar=settings.lidar, density=settings.density
        )
        progress.stage("Driving through a generated town with a LiDAR", sum(1 for _ in drive.poses()))
        self.scans_dir = scratch / "scans"
        self.scans_dir.mkdir()
        self.unbounded = UnboundedMap(settings.resolution, FILTER)
        self.path: list[tuple[float, float, float]] = []
        self.points = 0
        for number, scan in enumerate(drive.scans(), 1):
            np.savez(self.scans_dir / f"{number}.npz", xyz=scan.xyz, pose=scan.T_map_sensor)
            self.unbounded.add(scan.xyz, scan.T_map_sensor)
            x, y, z = scan.T_map_sensor[:3, 3].tolist()
            self.path.append((x, y, z))
            self.points += len(scan.xyz)
            progress.step()


def _draw(endpoint: str, drive: _Drive, scratch: Path) -> str:
    """The picture of ``shmmap-rolling``, of the whole map."""
    picture, path = scratch / "live.svg", scratch / "path.json"
    path.write_text(json.dumps(drive.path), encoding="utf-8")
    words = ["--endpoint", endpoint, "--live", _MAP, "--path", str(path), "--picture", str(picture)]
    with Program("picture", "shmmap_clients.demo.live_picture", words, scratch) as program:
        if code := program.wait(PATIENCE_S):
            raise InternalError(f"the picture ended with {code}: {program.last_words()}")
    return picture.read_text(encoding="utf-8")

# SPDX-License-Identifier: Apache-2.0
"""Map a drive into a live map with too little memory, and kill daemon and mapping program meanwhile.

The route is a loop through the town, and a part of it again, so that chunks are evicted and loaded again. At
the end the map's files are compared with a map of the same scans that has no memory limit.

``python -m shmmap.demo.live_drive ENDPOINT NAME SCANS`` is the mapping program.  It first prints the number
of the next scan that the live map NAME needs.  Each line of stdin is the number of a scan: the program adds
``SCANS/<number>.npz`` to the map and prints the map's number of scans. After the end of stdin it exits once
all scans are in the map.
"""

from __future__ import annotations

import contextlib
import json
import re
import sys
import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.chunks.occupancy import Occupancy, ScanFilter
from shmmap.chunks.voxels import CHUNK_VOXELS, WORDS, ChunkKey
from shmmap.daemon.live.disk.stored_map import StoredMap, opened_folder_to_read
from shmmap.demo.program import Program, Progress
from shmmap.errors import InternalError
from shmmap.processes.end_with_parent import with_us
from shmmap.processes.interrupts import scratch_directory
from shmmap.simulation.lidar import Lidar, LidarDrive
from shmmap.simulation.town import Town
from shmmap.testing.daemon_process import DaemonProcess

if TYPE_CHECKING:
    from shmmap.client.live.live_map import LiveMap

__all__ = [
    "FILTER",
    "LiveDriveResult",
    "LiveDriveSettings",
    "UnboundedMap",
    "main",
    "run_live_drive",
]

_MAP: Final = "town"
_LIDAR: Final = Lidar(rings=32, highest_deg=12.0, azimuth_deg=0.6, farthest=25.0)
_CONFIG: Final = """\
[live.{name}]
path = {path}
resolution = {resolution!r}
radius = 2
linger_s = 0.5
"""
FILTER: Final = ScanFilter(min_range=1.0, max_range=20.0, min_z=-8.0, max_z=12.0)
"""Filter of the points in the demonstration's scans."""
_TIMEOUT_S: Final = 300.0  # seconds for a compiler on a slow machine
_WITHOUT_DAEMON: Final = 2  # scans that arrive while no daemon runs


@dataclass(frozen=True, slots=True)
class LiveDriveSettings:
    """Settings of drive and map.

    Attributes
    ----------
    blocks, seed
        Size and random seed of the town; a loop in a town of 3 x 3 blocks is 320 m long.
    length, step
        Length of the drive, and distance between scans, metres.
    lidar, density
        The sensor, and points per square metre of the surfaces that it sees.
    resolution
        Edge of a voxel, metres.
    budget_bytes
        Memory budget of chunks.
    """

    blocks: tuple[int, int] = (3, 3)
    seed: int = 4
    length: float = 450.0
    step: float = 3.0
    lidar: Lidar = _LIDAR
    density: float = 15.0
    resolution: float = 0.2
    budget_bytes: int = 8 << 20


@dataclass(slots=True)
class LiveDriveResult:
    """Results of the mapping, the kills and the comparison.

    Attributes
    ----------
    scans, points, length_m
        Size of the drive.
    mapping_s
        Seconds from the first scan to the last, with both kills.
    mapper_killed_at, mapper_resumed_at
        Scan after which the mapping program was killed, and the first one of its next run.
    daemon_killed_at, daemon_down_s, daemon_chunks
        Scan after which the daemon was killed, seconds until it was ready again, and chunks that it then
        found in memory.
    evicted, came_back
        How often a chunk was evicted from memory, and how often one was loaded again.
    budget_bytes, max_bytes
        Memory budget of chunks, and peak memory of the chunks in use.
    active, active_bytes
        Known voxels in memory at the end of the drive, and memory of their chunks.
    chunks, file_bytes
        Size of the map on disk.
    voxels, differing
        Voxels known in the map on disk or in the map without memory limit, and the number that differ.
    picture_svg
        Picture of the map at the end of the drive, before all of it was saved.
    """

    scans: int
    points: int
    length_m: float
    budget_bytes: int
    mapping_s: float = 0.0
    mapper_killed_at: int = 0
    mapper_resumed_at: int = 0
    daemon_killed_at: int = 0
    daemon_down_s: float = 0.0
    daemon_chunks: int = 0
    evicted: int = 0
    came_back: int = 0
    max_bytes: int = 0
    active: int = 0
    active_bytes: int = 0
    chunks: int = 0
    file_bytes: int = 0
    voxels: int = 0
    differing: int = 0
    picture_svg: str = ""


def run_live_drive(settings: LiveDriveSettings, progress: Progress) -> LiveDriveResult:
    """Map a drive, kill daemon and program, compare the result, clean up.

    Raises
    ------
    PackageMissing
        numba is not installed.
    InternalError
        A process failed.
    """
    import shmmap

    with contextlib.ExitStack() as stack:
        work = Path(stack.enter_context(scratch_directory("shmmap-demo-")))
        map_dir, config = work / "map", work / "live.toml"
        config.write_text(
            _CONFIG.format(name=_MAP, path=json.dumps(str(map_dir)), resolution=settings.resolution),
            encoding="utf-8",
        )
        budgets = ["--budget", "16M", "--live-budget", str(settings.budget_bytes)]
        daemon = stack.push(DaemonProcess("", "--config", str(config), *budgets, command=with_us()))
        daemon.launch()  # the daemon starts while scans are made
        path, unbounded, result = _take_scans(settings, work, progress)
        daemon.wait_ready(_TIMEOUT_S)
        live = stack.enter_context(shmmap.connect(daemon.endpoint, name="demo")).live(_MAP)
        words = [daemon.endpoint, _MAP, str(work)]
        mapper = stack.enter_context(Program("mapping program", "shmmap.demo.live_drive", words, work))
        _map(daemon, mapper, _Watch(live, result), progress)
        progress.stage("Saving the map, comparing it with one without bounds", 3)
        live.move_to(*path[-1])  # the mapping program exits, the vehicle's pose stays
        mapper.end_input()
        mapper.finish(_TIMEOUT_S)
        usage = live.status()
        result.active, result.active_bytes = usage.active, usage.bytes
        result.picture_svg = _draw(daemon.endpoint, path, work)
        progress.step()
        live.save()
        files = live.status()
        result.chunks, result.file_bytes = files.files, files.file_bytes
        daemon.stop()
        progress.step()
        result.voxels, result.differing = unbounded.compare(str(map_dir))
        progress.step()
        return result


def _take_scans(
    settings: LiveDriveSettings, work: Path, progress: Progress
) -> tuple[list[tuple[float, float, float]], UnboundedMap, LiveDriveResult]:
    """Write the scans to ``work``; return the sensor's poses, the unbounded map, and the result."""
    drive = LidarDrive(
        Town(seed=settings.seed, blocks=settings.blocks),
        settings.length,
        settings.step,
        lidar=settings.lidar,
        density=settings.density,
    )
    progress.stage("Driving through a generated town with a LiDAR", sum(1 for _ in drive.poses()))
    unbounded = UnboundedMap(settings.resolution, FILTER)
    path = []
    points = 0
    for number, scan in enumerate(drive.scans(), 1):
        np.savez(work / f"{number}.npz", xyz=scan.xyz, pose=scan.T_map_sensor)
        unbounded.add(scan.xyz, scan.T_map_sensor)
        x, y, z = scan.T_map_sensor[:3, 3].tolist()
        path.append((x, y, z))
        points += len(scan.xyz)
        progress.step()
    return path, unbounded, LiveDriveResult(len(path), points, settings.length, settings.budget_bytes)


class _Watch:
    """Counts chunks that are evicted from memory, and those loaded again."""

    def __init__(self, live: LiveMap, result: LiveDriveResult) -> None:
        self.result = result
        self._live = live
        self._in_memory: set[ChunkKey] = set()
        self._on_disk: set[ChunkKey] = set()

    def look(self) -> str:
        """Update the counts from all chunks with known voxels; return them as text."""
        known = [row for row in self._live.chunks(saved=True) if row.active]
        on_disk = {row.key for row in known if row.state == "saved"}
        in_memory = {row.key for row in known} - on_disk
        result = self.result
        result.evicted += len(self._in_memory & on_disk)
        result.came_back += len(self._on_disk & in_memory)
        result.max_bytes = max(result.max_bytes, self._live.status().bytes)
        self._in_memory, self._on_disk = in_memory, on_disk
        return (
            f"{len(in_memory)} chunks in memory, {len(on_disk)} on disk alone; {result.came_back} came back"
        )


def _map(daemon: DaemonProcess, mapper: Program, watch: _Watch, progress: Progress) -> None:
    """Map all scans; kill program and daemon right after a scan was sent, which may be in the map or not."""
    result, scans = watch.result, watch.result.scans
    progress.stage("Mapping it, with memory for a part of the map", scans)
    began_s = time.perf_counter()
    number = int(mapper.read_line(_TIMEOUT_S))
    while number <= scans:
        mapper.write_line(str(number))
        mapper.read_line(_TIMEOUT_S)
        progress.step(f"scan {number}: {watch.look()}")
        if not result.mapper_killed_at and number >= scans // 3:
            result.mapper_killed_at = number
            mapper.kill()
            progress.event(f"The mapping program is killed (SIGKILL) after scan {number}")
            mapper.start()
            number = result.mapper_resumed_at = int(mapper.read_line(_TIMEOUT_S))
            progress.event(f"Its next run asks the daemon, and continues with scan {number}")
            continue
        if not result.daemon_killed_at and number >= 2 * scans // 3:
            result.daemon_killed_at = number
            sent = range(number + 1, min(number + _WITHOUT_DAEMON, scans) + 1)
            daemon.kill()
            killed_s = time.perf_counter()
            progress.event(f"The daemon is killed (SIGKILL) after scan {number}; the drive continues")
            for without_daemon in sent:
                mapper.write_line(str(without_daemon))
            daemon.start(_TIMEOUT_S)
            result.daemon_down_s = time.perf_counter() - killed_s
            # adopted by the daemon; some may have been evicted since
            found = re.findall(r" live map in memory .* chunks=(\d+)", daemon.log)
            result.daemon_chunks = int(found[-1]) if found else 0
            progress.event(f"It is back; it found {result.daemon_chunks} chunks in memory")
            for _ in sent:
                mapper.read_line(_TIMEOUT_S)
                progress.step()
            number += len(sent)
        number += 1
    result.mapping_s = time.perf_counter() - began_s
    watch.look()


def _draw(endpoint: str, path: list[tuple[float, float, float]], work: Path) -> str:
    """Draw the whole map, as ``shmmap-rolling`` does."""
    picture, path_file = work / "live.svg", work / "path.json"
    path_file.write_text(json.dumps(path), encoding="utf-8")
    words = ["--endpoint", endpoint, "--live", _MAP, "--path", str(path_file), "--picture", str(picture)]
    with Program("picture", "shmmap_clients.demo.live_picture", words, work) as program:
        program.finish(_TIMEOUT_S)
    if not picture.exists():
        raise InternalError("the picture was not drawn")
    return picture.read_text(encoding="utf-8")


class UnboundedMap:
    """Map without memory limit: stores the hits and misses of every scan in every chunk.

    Parameters
    ----------
    resolution
        Edge of a voxel, metres.
    scan_filter
        Filter of the points.
    """

    def __init__(self, resolution: float, scan_filter: ScanFilter) -> None:
        from shmmap.chunks.marking import Marker  # imports compiled kernels

        self._marker = Marker(resolution, scan_filter)
        self._said: dict[ChunkKey, list[tuple[NDArray[np.uint16], NDArray[np.uint64], int]]] = defaultdict(
            list
        )

    def add(self, points: NDArray[np.floating], pose: NDArray[np.floating]) -> None:
        """Add a scan: points (N, 3), metres, sensor frame, and T_map_sensor."""
        marks, _ = self._marker.mark(points, pose)
        starts = marks.starts.tolist()
        for at, (key, hits) in enumerate(zip(marks.chunks, marks.hits.tolist(), strict=True)):
            part = slice(starts[at], starts[at + 1])
            self._said[key].append((marks.words[part].copy(), marks.bits[part].copy(), hits))

    def chunk(self, key: ChunkKey, occupancy: Occupancy) -> NDArray[np.int16]:
        """Return log-odds (thousandths) of a chunk's voxels by place, added up over all scans."""
        hit, miss, low, high = occupancy.steps
        found = np.zeros((WORDS, 64), np.int16)
        for words, bits, hits in self._said.get(key, ()):
            voxels = np.unpackbits(bits.astype("<u8").view(np.uint8), bitorder="little").reshape(-1, 64)
            for part, step in ((slice(hits), hit), (slice(hits, None), miss)):
                before = found[words[part]]
                after = np.clip(before.astype(np.int32) + step, low, high).astype(np.int16)
                found[words[part]] = np.where(voxels[part] != 0, after, before)
        return found.reshape(CHUNK_VOXELS)

    def compare(self, path: str) -> tuple[int, int]:
        """Compare with the files of a live map, voxel by voxel.

        Returns
        -------
        voxels
            Number of voxels known in at least one of the maps.
        differing
            Number of these voxels that differ.

        Raises
        ------
        MapMissing, MapDataError
            The directory has no live map, or a file of the map cannot be read.
        """
        voxels = differing = 0
        nothing = np.zeros(CHUNK_VOXELS, np.int16)
        with opened_folder_to_read(path) as folder:
            stored = StoredMap(folder, path)
            for key in sorted({*self._said, *stored.chunks}):
                mine = self.chunk(key, stored.settings.occupancy)
                theirs = stored.chunk(key)[1].dense() if key in stored.chunks else nothing
                voxels += int(np.count_nonzero(mine | theirs))
                differing += int(np.count_nonzero(mine != theirs))
        return voxels, differing


def main(argv: list[str]) -> int:
    """Add scans to the live map until stdin ends."""
    import shmmap

    endpoint, name, scans = argv
    with (
        shmmap.connect(endpoint, name="demo mapper") as client,
        client.live(name).mapper("demo", FILTER) as mapper,
    ):
        _print(mapper.applied + 1)
        for line in sys.stdin:
            number = int(line)
            with np.load(Path(scans, f"{number}.npz")) as scan:
                sent = mapper.add(scan["xyz"], scan["pose"])
            if sent != number:
                raise InternalError(f"scan {number} was sent as {sent}")
            _print(mapper.applied)
        mapper.wait_applied()
    return 0


def _print(number: int) -> None:
    sys.stdout.write(f"{number}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

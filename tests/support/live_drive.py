# SPDX-License-Identifier: Apache-2.0
"""A drive for live maps, and a program that takes it in: it is killed, and says what was applied before.

    python -m tests.support.live_drive SHM_DIRECTORY MAP_DIRECTORY BUDGET CHECKPOINT_S FIRST_SCAN

It prints ``applied N`` and ``durable N`` for each scan; when all of it is on the disk how many chunks were
given up and the most bytes that all took, and ``done``.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shmmap.chunks.chunk_file import decode_chunk
from shmmap.chunks.layout import ChunkView, check_consistent
from shmmap.chunks.marking import Marker
from shmmap.chunks.marks import Marks
from shmmap.chunks.occupancy import ScanFilter
from shmmap.chunks.voxels import ChunkKey, voxels_of
from shmmap.daemon.live.chunk_memory import ChunkMemory, live_prefix
from shmmap.daemon.live.disk.folder import Folder
from shmmap.daemon.live.disk.map_files import MapFiles
from shmmap.daemon.live.disk.map_record import MapSettings
from shmmap.daemon.live.paged_map import Observer, PagedMap
from shmmap.daemon.live.paging.durability import Scan
from shmmap.daemon.live.paging.residency import Limits

RESOLUTION = 0.2
SETTINGS = MapSettings(resolution=RESOLUTION)
FILTER = ScanFilter(0.2, 9.0, -5.0, 5.0)
SCANS = 24


def drive(scans: int = SCANS) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Points and poses along a path that crosses chunks, comes back, and jumps."""
    rng = np.random.default_rng(8)
    found = []
    for number in range(scans):
        pose, yaw = np.eye(4), 0.3 * number
        pose[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
        pose[:3, 3] = [20.0 * math.sin(0.5 * number), -7.0 * number % 31.0, 0.2 * number]
        if number % 6 == 5:
            pose[:3, 3] -= 300.0
        found.append((rng.normal(0.0, 4.0, (150, 3)), pose))
    return found


def marked(scans: int = SCANS) -> list[Marks]:
    """The same as marks."""
    marker = Marker(RESOLUTION, FILTER)
    return [marker.mark(points, pose)[0] for points, pose in drive(scans)]


class Observed:
    """Notes what happens to a map; it may print it, too."""

    def __init__(self, *, prints: bool = False) -> None:
        self.gone: list[ChunkKey] = []
        self._prints = prints

    def scan_applied(self, scan: Scan) -> None:
        if self._prints:
            print(f"applied {scan.number}", flush=True)

    def scan_durable(self, scan: Scan) -> None:
        if self._prints:
            print(f"durable {scan.number}", flush=True)

    def chunk_changed(self, key: ChunkKey) -> None:
        """Nothing is noted."""

    def chunk_gone(self, key: ChunkKey) -> None:
        self.gone.append(key)


def opened(
    shm: Path, disk: Path, budget: int, checkpoint_s: float = 1.0, observer: Observer | None = None
) -> tuple[PagedMap, Folder]:
    """Open the map, with what a previous process left."""
    folder = Folder(disk)
    limits = Limits(budget, linger_s=0.05, checkpoint_s=checkpoint_s, waiting_bytes=1)
    memory = ChunkMemory(str(shm), live_prefix("test", "lidar"))
    made = PagedMap(MapFiles(folder, SETTINGS), memory, limits, observer or Observed())
    try:
        made.adopt(time.monotonic())
    except OSError:
        made.close()
        folder.close()
        raise
    return made, folder


def voxels_on_disk(files: MapFiles, made: PagedMap) -> dict[Voxel, int]:
    """All known voxels, by the chunks' files; every one of them can be read."""
    found: dict[Voxel, int] = {}
    for key in files.rows:
        data = files.load(key)
        assert data is not None
        view = ChunkView(decode_chunk(data, made.identity(key, 1)))
        check_consistent(view)
        dense = view.dense()
        places = np.flatnonzero(dense)
        for voxel, value in zip(voxels_of(key, places).tolist(), dense[places].tolist(), strict=True):
            found[voxel[0], voxel[1], voxel[2]] = value
    return found


def main() -> None:
    """Take in the drive from a scan on, and save everything."""
    shm, disk = map(Path, sys.argv[1:3])
    observer = Observed(prints=True)
    made, folder = opened(shm, disk, int(sys.argv[3]), float(sys.argv[4]), observer)
    first = int(sys.argv[5])
    waiting = list(enumerate(marked(), 1))[first - 1 :]
    most = 0
    poses = [pose for _, pose in drive()]
    while waiting or not made.all_durable:
        if waiting and made.residency.has_room(1):
            number, marks = waiting.pop(0)
            made.move("mapper", tuple(poses[number - 1][:3, 3].tolist()))
            made.add(1, number, marks, 1)
        made.run_turn(time.monotonic(), time.time_ns(), save_all=not waiting)
        most = max(most, made.residency.chunk_bytes + made.residency.beside_bytes)
        made.wait(0.05)
    made.files.write_manifest()
    made.close()
    folder.close()
    print(f"evicted {len(observer.gone)}\nmost {most}\ndone", flush=True)


# -- a rolling map that is right because it is slow: one dictionary, one voxel after the other, no chunks


Voxel = tuple[int, int, int]


def walk(start: Voxel, end: Voxel) -> list[Voxel]:
    """Voxels of a ray, its end excluded: one a step of the longest axis."""
    delta = [abs(b - a) for a, b in zip(start, end, strict=True)]
    sign = [-1 if b < a else 1 for a, b in zip(start, end, strict=True)]
    longest = max(delta)
    error, at, found = [0, 0, 0], list(start), []
    for _ in range(longest):
        found.append((at[0], at[1], at[2]))
        for axis in range(3):
            error[axis] += delta[axis]
            if 2 * error[axis] >= longest:
                at[axis] += sign[axis]
                error[axis] -= longest
    return found


@dataclass
class SlowOccupancy:
    """Log-odds by voxel; a voxel that is not there is unknown."""

    resolution: float
    hit: int = 847
    miss: int = -405
    clamp_min: int = -1992
    clamp_max: int = 3476
    min_range: float = 0.5
    max_range: float = 5.0
    min_z: float = -2.0
    max_z: float = 2.0
    voxels: dict[Voxel, int] = field(default_factory=dict)

    def voxel(self, x: float, y: float, z: float) -> Voxel:
        """The voxel that a point lies in."""
        inverse = 1.0 / self.resolution
        return math.floor(x * inverse), math.floor(y * inverse), math.floor(z * inverse)

    def marks(
        self, points: Iterable[Iterable[float]], pose: list[list[float]]
    ) -> tuple[set[Voxel], set[Voxel]]:
        """Voxels that a scan hits, and those that it passes through."""
        near: set[Voxel] = set()
        far: set[Voxel] = set()
        origin = [row[3] for row in pose]
        for point in points:
            p = [float(value) for value in point]
            if not all(map(math.isfinite, p)) or not self.min_z <= p[2] <= self.max_z:
                continue
            if p[0] * p[0] + p[1] * p[1] + p[2] * p[2] < self.min_range * self.min_range:
                continue
            to = [row[0] * p[0] + row[1] * p[1] + row[2] * p[2] + row[3] for row in pose]
            d = [a - b for a, b in zip(to, origin, strict=True)]
            squared = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
            if squared >= self.max_range * self.max_range:
                length = math.sqrt(squared)
                cut = [o + part / length * self.max_range for o, part in zip(origin, d, strict=True)]
                far.add(self.voxel(*cut))
            else:
                near.add(self.voxel(*to))
        start = self.voxel(*origin)
        passed = far - near
        for end in near | far:
            passed.update(walk(start, end))
        return near, passed - near

    def add(self, hits: Iterable[Voxel], misses: Iterable[Voxel]) -> None:
        """Add evidence; what comes to 0 is unknown."""
        for voxels, worth in ((hits, self.hit), (misses, self.miss)):
            for voxel in voxels:
                value = min(max(self.voxels.get(voxel, 0) + worth, self.clamp_min), self.clamp_max)
                if value:
                    self.voxels[voxel] = value
                else:
                    self.voxels.pop(voxel, None)

    def insert(self, points: Iterable[Iterable[float]], pose: list[list[float]]) -> None:
        """Take a scan in."""
        self.add(*self.marks(points, pose))


if __name__ == "__main__":
    main()

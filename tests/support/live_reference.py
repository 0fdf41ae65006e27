# SPDX-License-Identifier: Apache-2.0
"""Live maps: what one holds after the drive of `tests.support.live_drive`, as files, in a daemon."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from contextlib import closing
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

import shmmap
from shmmap.chunks.chunk_file import encode_chunk, read_file_header
from shmmap.chunks.marking import Marker
from shmmap.chunks.voxels import ChunkKey
from shmmap.client.live.chunk_reader import ChunkInfo
from shmmap.client.live.live_map import LiveMap
from shmmap.live_worker.disk.folder import Folder
from shmmap.live_worker.disk.map_database import MapDatabase
from shmmap.live_worker.disk.map_record import MapSettings, Row
from tests.support.chunk_memory import ChunkMemory
from tests.support.daemon_process import DaemonProcess
from tests.support.live_drive import FILTER, RESOLUTION, SETTINGS, SlowOccupancy, Voxel, drive

Scan = tuple[NDArray[np.float64], NDArray[np.float64]]


def reference(scans: Iterable[Scan], scan_filter: shmmap.live.ScanFilter = FILTER) -> dict[Voxel, int]:
    """Log-odds of all known voxels after these scans."""
    slow = SlowOccupancy(
        RESOLUTION,
        min_range=scan_filter.min_range,
        max_range=scan_filter.max_range,
        min_z=scan_filter.min_z,
        max_z=scan_filter.max_z,
    )
    for points, pose in scans:
        slow.insert(points.tolist(), pose[:3].tolist())
    return {voxel: value for voxel, value in slow.voxels.items() if value}


def held(live: LiveMap, scope: str = "all", area: shmmap.Box | None = None) -> dict[Voxel, int]:
    """Log-odds of all known voxels that a live map has."""
    found: dict[Voxel, int] = {}
    for kind in ("occupied", "free"):
        voxels = live.voxels(kind, area, scope=scope)
        for (x, y, z), value in zip(voxels.indices.tolist(), voxels.log_odds.tolist(), strict=True):
            assert (x, y, z) not in found
            found[x, y, z] = value
    return found


def map_scans(live: LiveMap, scans: Iterable[Scan], name: str = "front") -> None:
    """Map scans under a name, until all are applied."""
    with live.mapper(name, FILTER) as mapper:
        for points, pose in scans:
            mapper.add(points, pose)
        mapper.wait_applied()


def mapped_around(live: LiveMap, here: ChunkKey) -> list[ChunkInfo]:
    """Return the chunks in memory that touch this one, itself among them; 27 once all have been loaded."""
    return [one for one in live.chunks() if one.key.distance(here) <= 1 and one.state != "loading"]


# The directory of a live map in which a short drive is saved


def stored_drive(
    directory: Path,
    scans: int = 6,
    *,
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
    settings: MapSettings = SETTINGS,
    codec: str = "zlib",
) -> dict[Voxel, int]:
    """Map a drive, moved by metres, and save it; returns all voxels known."""
    with closing(Folder(directory)) as folder, closing(MapDatabase(folder, settings)) as database:
        memory = _driven(scans, shift, settings, database.map_id)
        for key, view in memory.chunks.items():
            database.save(key, encode_chunk(view, codec))
        database.write_record()
    return memory.voxels()


def _driven(
    scans: int, shift: tuple[float, float, float], settings: MapSettings, map_id: bytes
) -> ChunkMemory:
    memory = ChunkMemory(RESOLUTION, settings.occupancy, map_id)
    marker = Marker(RESOLUTION, FILTER)
    for number, (points, pose) in enumerate(drive(scans), 1):
        pose[:3, 3] += shift
        memory.apply(marker.mark(points, pose)[0], scan=number)
    return memory


def old_directory(directory: Path, scans: int = 6) -> dict[Voxel, int]:
    """Save a drive as versions before 0.4 did, with a file for each chunk; returns all voxels known."""
    directory.mkdir(mode=0o700)
    map_id = bytes(range(16))
    memory = _driven(scans, (0.0, 0.0, 0.0), SETTINGS, map_id)
    rows = {}
    for key, view in memory.chunks.items():
        data = encode_chunk(view)
        (directory / f"{key.text}.chunk").write_bytes(data)
        rows[key.text] = msgspec.to_builtins(Row.of(read_file_header(data)))
    settings = msgspec.to_builtins(SETTINGS)
    mappers = [{"number": 1, "uid": 1000, "name": "front", "scans": 1 << 20}]
    record = {"format": 1, "map_id": map_id.hex(), "settings": settings, "mappers": mappers, "lives": 3}
    (directory / "map.json").write_text(json.dumps({**record, "next_mapper": 2}))
    manifest = {"format": 1, "chunks": rows, "applied": {"1": scans}, "missing": {}}
    (directory / "manifest.json").write_text(json.dumps(manifest))
    return memory.voxels()


def contents(directory: Path) -> dict[str, bytes]:
    """Every file below a directory."""
    return {
        str(path.relative_to(directory)): path.read_bytes()
        for path in sorted(directory.rglob("*"))
        if path.is_file()
    }


# A daemon that keeps one live map


LIVE_TOML = """\
[live.lidar]
resolution = {resolution}
linger_s = 0.05
checkpoint_s = {checkpoint}
path = "{path}"
"""

LiveDaemon = Callable[..., DaemonProcess]


def worker_of(one: DaemonProcess) -> int:
    """Id of the live worker."""
    (found,) = (pid for pid in one.children() if b"live_worker" in Path(f"/proc/{pid}/cmdline").read_bytes())
    return found

# SPDX-License-Identifier: Apache-2.0
"""The directory of a live map in which a short drive is saved."""

from __future__ import annotations

from pathlib import Path

from shmmap.chunks.chunk_file import encode_chunk
from shmmap.chunks.marking import Marker
from shmmap.daemon.live.disk.folder import Folder
from shmmap.daemon.live.disk.map_files import MapFiles
from shmmap.daemon.live.disk.map_record import MapSettings
from tests.support.chunk_memory import ChunkMemory
from tests.support.live_drive import FILTER, RESOLUTION, SETTINGS, drive
from tests.support.slow_occupancy import Voxel


def stored_drive(
    directory: Path,
    scans: int = 6,
    *,
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
    settings: MapSettings = SETTINGS,
    codec: str = "zlib",
) -> dict[Voxel, int]:
    """Map a drive, moved by metres, and save it; returns all voxels known."""
    folder = Folder(directory)
    files = MapFiles(folder, settings)
    memory = ChunkMemory(RESOLUTION, settings.occupancy, files.map_id)
    marker = Marker(RESOLUTION, FILTER)
    for number, (points, pose) in enumerate(drive(scans), 1):
        pose[:3, 3] += shift
        memory.apply(marker.mark(points, pose)[0], scan=number)
    for key, view in memory.chunks.items():
        files.save(key, encode_chunk(view, codec))
    files.write_manifest()
    folder.close()
    return memory.voxels()


def contents(directory: Path) -> dict[str, bytes]:
    """Every file below a directory."""
    return {
        str(path.relative_to(directory)): path.read_bytes()
        for path in sorted(directory.rglob("*"))
        if path.is_file()
    }

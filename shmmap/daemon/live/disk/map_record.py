# SPDX-License-Identifier: Apache-2.0
"""What the directory of a live map says of it: ``map.json``, ``manifest.json``, and the names of its files.

``map_files.py`` says what they are for.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import msgspec

from shmmap.chunks.chunk_file import FILE_HEADER_BYTES, ChunkFileHeader
from shmmap.chunks.layout import ChunkIdentity
from shmmap.chunks.occupancy import Occupancy
from shmmap.chunks.voxels import ChunkKey
from shmmap.daemon.live.folder import Files, FilesToRead, replace_file
from shmmap.errors import ConfigError, MapDataError

__all__ = [
    "CHUNK",
    "MANIFEST",
    "MAP_FILE",
    "MAP_FORMAT",
    "Manifest",
    "MapRecord",
    "MapSettings",
    "Mapper",
    "Row",
    "read_map",
    "write_rows",
]

MAP_FILE: Final = "map.json"
MANIFEST: Final = "manifest.json"
MAP_FORMAT: Final = 1
CHUNK: Final = ".chunk"
"""How the names of chunks' files end."""


class MapSettings(msgspec.Struct, frozen=True):
    """What is fixed when a map is made.

    Attributes
    ----------
    resolution
        Edge of a voxel, metres.
    occupancy
        What a hit and a miss are worth.
    frame_id
        Frame of the map.
    """

    resolution: float = 0.05
    occupancy: Occupancy = Occupancy()
    frame_id: str = "map"

    def identity(self, map_id: bytes, key: ChunkKey, generation: int) -> ChunkIdentity:
        """What a chunk of a map of this kind is in memory."""
        _, _, low, high = self.occupancy.steps
        return ChunkIdentity(
            map_id, key, self.resolution, low, high, *self.occupancy.thresholds, generation, self.frame_id
        )


class Mapper(msgspec.Struct):
    """Who maps: a user and the name that a program of theirs chose.

    Attributes
    ----------
    number
        Stands for it in chunks, and is never given to another.
    scans
        All scans that it sent have smaller numbers; true on disk before one is applied.
    """

    number: int
    uid: int
    name: str
    scans: int = 0


class Row(msgspec.Struct, frozen=True):
    """What is known of a chunk's file without opening it."""

    version: int
    bytes: int
    active: int
    occupied: int
    free: int
    bricks: int

    @classmethod
    def of(cls, header: ChunkFileHeader) -> Row:
        """What a whole file's header says."""
        size = FILE_HEADER_BYTES + header.stored_bytes
        return cls(header.version, size, header.active, header.occupied, header.free, header.bricks)


class MapRecord(msgspec.Struct):
    """``map.json``."""

    format: int
    map_id: str
    settings: MapSettings
    mappers: list[Mapper] = []
    next_mapper: int = 1
    lives: int = 0


class Manifest(msgspec.Struct):
    """``manifest.json``.

    Attributes
    ----------
    chunks
        Those that are durable.
    applied
        Up to which scan of each mapper, by its number, all are durable: at least.
    """

    format: int
    chunks: dict[str, Row]
    applied: dict[int, int] = {}


def read_map(files: FilesToRead) -> MapRecord:
    """What ``map.json`` says.

    Raises
    ------
    MapDataError
        It is not what it should be.
    OSError
        It cannot be read.
    """
    try:
        found = msgspec.json.decode(files.read(MAP_FILE), type=MapRecord)
        bytes.fromhex(found.map_id)
    except (msgspec.MsgspecError, ValueError, ConfigError) as error:
        raise MapDataError(f"it does not say what the map is: {error}", path=MAP_FILE) from error
    if found.format != MAP_FORMAT or len(found.map_id) != 32:
        raise MapDataError(f"format {found.format}; this reads {MAP_FORMAT}", path=MAP_FILE)
    return found


def write_rows(files: Files, rows: Mapping[ChunkKey, Row], applied: dict[int, int]) -> None:
    """Write the manifest: these chunks, and all scans of mappers up to these, are durable."""
    listed = Manifest(MAP_FORMAT, {key.text: row for key, row in rows.items()}, applied)
    replace_file(files, MANIFEST, msgspec.json.encode(listed))
    files.sync_names()

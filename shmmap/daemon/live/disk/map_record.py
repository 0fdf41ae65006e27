# SPDX-License-Identifier: Apache-2.0
"""What the directory of a live map says of it: ``map.json``, ``manifest.json``, and the names of its files.

``map_files.py`` says what they are for.  Whatever is in a file, reading it is bounded, and what it cannot be
is a `MapDataError`.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Mapping
from typing import Annotated, Final, TypeAlias, TypeVar

import msgspec

from shmmap.chunks.chunk_file import FILE_HEADER_BYTES, ChunkFileHeader
from shmmap.chunks.layout import MAPPERS, MOST_FRAME_BYTES, ChunkIdentity
from shmmap.chunks.layout import MOST_BYTES as MOST_CHUNK_BYTES
from shmmap.chunks.occupancy import Occupancy
from shmmap.chunks.voxels import ChunkKey
from shmmap.daemon.live.folder import MOST_BYTES, Files, FilesToRead, replace_file
from shmmap.errors import BadRequest, ConfigError, MapDataError

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
    "keys_of",
    "read_chunk",
    "read_manifest",
    "read_map",
    "write_rows",
]

_T = TypeVar("_T")

MAP_FILE: Final = "map.json"
MANIFEST: Final = "manifest.json"
MAP_FORMAT: Final = 1
CHUNK: Final = ".chunk"
"""How the names of chunks' files end."""

_MOST_CHUNK_BYTES: Final = 2 * MOST_CHUNK_BYTES
"""Of a chunk's file: what cannot be compressed gets a little longer by that."""
_MOST_MAP_BYTES: Final = 1 << 20
_MOST_MANIFEST_BYTES: Final = MOST_BYTES - 1
"""Of ``map.json``, and of ``manifest.json``: about two million chunks."""
_MAP_ID: Final = re.compile(r"[0-9a-f]{32}")
_RESOLUTION_M: Final = (1e-4, 1e3)
_NOT_DECODED: Final = (
    msgspec.MsgspecError, ValueError, ConfigError, RecursionError, MemoryError, OverflowError, struct.error,
)  # fmt: skip
"""What decoders raise for damaged bytes."""

Count: TypeAlias = Annotated[int, msgspec.Meta(ge=0, le=(1 << 62) - 1)]
"""Of a file that may have been changed: never negative, and something can be added."""


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

    number: Annotated[int, msgspec.Meta(ge=1, le=1 << 53)]
    uid: Annotated[int, msgspec.Meta(ge=0, lt=1 << 32)]
    name: str
    scans: Count = 0


class Row(msgspec.Struct, frozen=True):
    """What is known of a chunk's file without opening it."""

    version: Count
    bytes: Count
    active: Count
    occupied: Count
    free: Count
    bricks: Count

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
    next_mapper: Annotated[int, msgspec.Meta(ge=1, le=1 << 53)] = 1
    lives: Annotated[int, msgspec.Meta(ge=0, lt=(1 << 31) - 1)] = 0


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
    applied: dict[int, Count] = {}


def keys_of(names: Iterable[str]) -> tuple[dict[ChunkKey, str], list[str]]:
    """Files of chunks by key, in the order of the keys; and those called so that no chunk can have."""
    found: dict[ChunkKey, str] = {}
    strange: list[str] = []
    for name in names:
        if name.endswith(CHUNK):
            try:
                found[ChunkKey.from_text(name.removesuffix(CHUNK))] = name
            except BadRequest:
                strange.append(name)
    return dict(sorted(found.items())), strange


def _whole(files: FilesToRead, name: str, most: int) -> bytes:
    """All of a file that is no longer than it can be; raises as `read_map`."""
    data = files.read(name, most + 1)
    if len(data) > most:
        raise MapDataError(f"it has more than {most:,} bytes", path=name, cause="too_long")
    return data


def read_chunk(files: FilesToRead, name: str) -> bytes:
    """Return the whole file of a chunk, which may be anything yet; raises as `read_map`."""
    return _whole(files, name, _MOST_CHUNK_BYTES)


# made here, once: msgspec ends the process if threads are the first to decode a type at the same time
_map_record: Final = msgspec.json.Decoder(MapRecord)
_manifest: Final = msgspec.json.Decoder(Manifest)


def _decoded(data: bytes, decoder: msgspec.json.Decoder[_T], name: str) -> _T:
    try:
        return decoder.decode(data)
    except _NOT_DECODED as error:
        said = str(error) or type(error).__name__
        raise MapDataError(f"it is damaged: {said}", path=name) from error


def read_map(files: FilesToRead) -> MapRecord:
    """Return what ``map.json`` says.

    Raises
    ------
    MapDataError
        It is not what it should be.
    OSError
        It cannot be read.
    """
    found = _decoded(_whole(files, MAP_FILE, _MOST_MAP_BYTES), _map_record, MAP_FILE)
    if found.format != MAP_FORMAT:
        raise MapDataError(f"format {found.format}; this reads {MAP_FORMAT}", path=MAP_FILE)
    numbers = [one.number for one in found.mappers]
    least, most = _RESOLUTION_M
    for is_so, what in (
        (_MAP_ID.fullmatch(found.map_id), "map_id is not 32 hexadecimal digits"),
        (least <= found.settings.resolution <= most, f"resolution {found.settings.resolution!r}"),
        (0 < len(found.settings.frame_id.encode()) <= MOST_FRAME_BYTES, "frame_id is empty or too long"),
        (len(numbers) <= MAPPERS, f"{len(numbers)} mappers; {MAPPERS} are the most"),
        (len(set(numbers)) == len(numbers), "two mappers have one number"),
        (max(numbers, default=0) < found.next_mapper, "a mapper has a number that was not given yet"),
    ):
        if not is_so:
            raise MapDataError(f"it is damaged: {what}", path=MAP_FILE)
    return found


def read_manifest(files: FilesToRead) -> tuple[dict[ChunkKey, Row], dict[int, int]]:
    """Return the chunks that the manifest lists, and up to which scan of each mapper all are durable.

    Raises
    ------
    MapDataError
        It is not what it should be.
    OSError
        It cannot be read; FileNotFoundError: there is none.
    """
    found = _decoded(_whole(files, MANIFEST, _MOST_MANIFEST_BYTES), _manifest, MANIFEST)
    if found.format != MAP_FORMAT:
        raise MapDataError(f"format {found.format}; this reads {MAP_FORMAT}", path=MANIFEST)
    try:
        return {ChunkKey.from_text(text): row for text, row in found.chunks.items()}, found.applied
    except BadRequest as error:
        raise MapDataError(f"it is damaged: {error.message}", path=MANIFEST) from error


def write_rows(files: Files, rows: Mapping[ChunkKey, Row], applied: dict[int, int]) -> None:
    """Write the manifest: these chunks, and all scans of mappers up to these, are durable."""
    listed = Manifest(MAP_FORMAT, {key.text: row for key, row in rows.items()}, applied)
    replace_file(files, MANIFEST, msgspec.json.encode(listed))
    files.sync_names()

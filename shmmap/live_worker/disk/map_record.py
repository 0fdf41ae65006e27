# SPDX-License-Identifier: Apache-2.0
"""The record of a live map: its settings, its mappers, and the chunks that are lost.

It is a row of the database; ``map.json`` is a copy, in case the database is damaged.  Invalid content raises
`MapDataError`.
"""

from __future__ import annotations

import re
import struct
from typing import Annotated, Final, TypeAlias, TypeVar

import msgspec

from shmmap.chunks.chunk_file import FILE_HEADER_BYTES, ChunkFileHeader
from shmmap.chunks.layout import MAPPERS, MAX_FRAME_BYTES, ChunkIdentity
from shmmap.chunks.occupancy import Occupancy
from shmmap.chunks.voxels import ChunkKey
from shmmap.errors import BadRequest, ConfigError, MapDataError
from shmmap.live_worker.disk.folder import FolderToRead

_T = TypeVar("_T")

MAP_FILE: Final = "map.json"
MAP_FORMAT: Final = 2
OLD_FORMAT: Final = 1
"""Of a directory in which each chunk is a file: until 0.3."""
_MAX_MAP_BYTES: Final = 1 << 26
_MAP_ID: Final = re.compile(r"[0-9a-f]{32}")
_RESOLUTION_M: Final = (1e-4, 1e3)
_NOT_DECODED: Final = (
    msgspec.MsgspecError,
    ValueError,
    ConfigError,
    RecursionError,
    MemoryError,
    OverflowError,
    struct.error,
)
"""Exceptions that decoders raise for damaged bytes."""

Count: TypeAlias = Annotated[int, msgspec.Meta(ge=0, le=(1 << 62) - 1)]
"""A number in a file that may be damaged: never negative, and small enough to add to."""


class MapSettings(msgspec.Struct, frozen=True):
    """Settings that are fixed when a map is created.

    Attributes
    ----------
    resolution
        Edge of a voxel, metres.
    occupancy
        Parameters of the log-odds update: weights of hits and misses, bounds and thresholds.
    frame_id
        Frame of the map.
    """

    resolution: float = 0.05
    occupancy: Occupancy = Occupancy()
    frame_id: str = "map"

    def identity(self, map_id: bytes, key: ChunkKey, generation: int) -> ChunkIdentity:
        """Return the identity of a chunk in memory, of a map with these settings."""
        _, _, low, high = self.occupancy.steps
        return ChunkIdentity(
            map_id, key, self.resolution, low, high, *self.occupancy.thresholds, generation, self.frame_id
        )


class Mapper(msgspec.Struct):
    """A user and the name that one of the user's programs chose.

    Attributes
    ----------
    number
        Identifies the mapper in chunks; never used for another one.
    scans
        Upper bound of the numbers of its scans; on disk before a scan is applied.
    """

    number: Annotated[int, msgspec.Meta(ge=1, le=1 << 53)]
    uid: Annotated[int, msgspec.Meta(ge=0, lt=1 << 32)]
    name: str
    scans: Count = 0


class Row(msgspec.Struct, frozen=True):
    """Data about a saved chunk that is known without reading it."""

    version: Count
    bytes: Count
    active: Count
    occupied: Count
    free: Count
    bricks: Count

    @classmethod
    def of(cls, header: ChunkFileHeader) -> Row:
        """Return the row of a complete file with this header."""
        size = FILE_HEADER_BYTES + header.stored_bytes
        return cls(header.version, size, header.active, header.occupied, header.free, header.bricks)


class Lost(msgspec.Struct, frozen=True):
    """A chunk of which something that was saved is lost.

    Attributes
    ----------
    version
        Version that was saved; 0 if unknown.
    reason
        What was found.
    remade
        Whether memory may have the chunk again, without what is lost.
    """

    version: Count
    reason: str
    remade: bool = False

    @property
    def text(self) -> str:
        """What is lost."""
        return f"version {self.version} is missing" if self.version else "what was saved is missing"


class MapRecord(msgspec.Struct):
    """Everything about a map but its chunks.

    Attributes
    ----------
    applied
        For each mapper's number, the last scan up to which at least all are durable.
    lost
        Chunks that lost something, by key, until that is forgotten on purpose.
    damaged
        Numbers of damaged rows, which stay as they are and do not count.
    """

    format: int
    map_id: str
    settings: MapSettings
    mappers: list[Mapper] = []
    next_mapper: Annotated[int, msgspec.Meta(ge=1, le=1 << 53)] = 1
    runs: Annotated[int, msgspec.Meta(ge=0, lt=(1 << 31) - 1)] = msgspec.field(default=0, name="lives")
    applied: dict[int, Count] = {}
    lost: dict[str, Lost] = {}
    damaged: list[Count] = []

    @property
    def lost_chunks(self) -> dict[ChunkKey, Lost]:
        """The lost chunks by their keys."""
        return {ChunkKey.from_text(text): one for text, one in self.lost.items()}


# created once, here: msgspec crashes if several threads decode a type for the first time concurrently
_map_record: Final = msgspec.json.Decoder(MapRecord)


def decoded(data: bytes | str, decoder: msgspec.json.Decoder[_T], name: str) -> _T:
    """Decode JSON that may be damaged; raise `MapDataError`."""
    try:
        return decoder.decode(data)
    except _NOT_DECODED as error:
        reason = str(error) or type(error).__name__
        raise MapDataError(f"it is damaged: {reason}", path=name) from error


def read_map(folder: FolderToRead) -> MapRecord:
    """Read ``map.json``, which may be that of a directory without a database.

    Raises
    ------
    MapDataError
        The file is damaged or invalid.
    OSError
        It cannot be read.
    """
    data = whole_file(folder, MAP_FILE, _MAX_MAP_BYTES)
    return decode_map(data, MAP_FILE, formats=(OLD_FORMAT, MAP_FORMAT))


def decode_map(data: bytes | str, path: str, *, formats: tuple[int, ...] = (MAP_FORMAT,)) -> MapRecord:
    """Return a record that is as it was written; else raise `MapDataError`."""
    found = decoded(data, _map_record, path)
    if found.format not in formats:
        raise MapDataError(f"format {found.format}; this reads {MAP_FORMAT}", path=path)
    numbers = [one.number for one in found.mappers]
    least, most = _RESOLUTION_M
    for is_right, what in (
        (_MAP_ID.fullmatch(found.map_id), "map_id is not 32 hexadecimal digits"),
        (least <= found.settings.resolution <= most, f"resolution {found.settings.resolution!r}"),
        (0 < len(found.settings.frame_id.encode()) <= MAX_FRAME_BYTES, "frame_id is empty or too long"),
        (len(numbers) <= MAPPERS, f"{len(numbers)} mappers; {MAPPERS} are the most"),
        (len(set(numbers)) == len(numbers), "two mappers have one number"),
        (all(map(_is_key, found.lost)), "a lost chunk has no key"),
        (max(numbers, default=0) < found.next_mapper, "a mapper has a number that was not given yet"),
    ):
        if not is_right:
            raise MapDataError(f"it is damaged: {what}", path=path)
    return found


def _is_key(text: str) -> bool:
    try:
        ChunkKey.from_text(text)
    except BadRequest:
        return False
    return True


def whole_file(folder: FolderToRead, name: str, most: int) -> bytes:
    """Return a whole file of at most ``most`` bytes; raise as `read_map`."""
    data = folder.read(name, most + 1)
    if len(data) > most:
        raise MapDataError(f"it has more than {most:,} bytes", path=name, cause="too_long")
    return data

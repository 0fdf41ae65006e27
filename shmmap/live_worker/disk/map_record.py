# SPDX-License-Identifier: Apache-2.0
"""The record of a live map: its settings, its mappers, and the chunks that are lost.

It is a row of the database; ``map.json`` is a copy, in case the database is damaged.  Invalid content raises
`MapDataError`.
"""

from __future__ import annotations

from pathlib import Path
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
_NOT_DECODED: Final = (
    msgspec.MsgspecError,
    ValueError,
    BadRequest,
    ConfigError,
    RecursionError,
    MemoryError,
    OverflowError,
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

    resolution: Annotated[float, msgspec.Meta(ge=1e-4, le=1e3)] = 0.05
    occupancy: Occupancy = Occupancy()
    frame_id: str = "map"

    def __post_init__(self) -> None:
        if not 0 < len(self.frame_id.encode()) <= MAX_FRAME_BYTES:
            raise ValueError("frame_id is empty or too long")

    def identity(self, map_id: bytes, key: ChunkKey, generation: int) -> ChunkIdentity:
        """Return the identity of a chunk in memory, of a map with these settings."""
        _, _, low, high = self.occupancy.steps
        return ChunkIdentity(
            map_id, key, self.resolution, low, high, *self.occupancy.thresholds, generation, self.frame_id
        )


def check_settings(found: MapSettings, wanted: MapSettings) -> None:
    """Check that a map was made with these settings; else raise `ConfigError`."""
    old_ones = _flat(found)
    for name, new in _flat(wanted).items():
        if (old := old_ones[name]) != new:
            raise ConfigError(
                f"{name} = {new!r}: the map was made with {old!r}",
                key=name,
                hint="leave it as it was, or choose another directory for a new map",
            )


def _flat(settings: MapSettings) -> dict[str, object]:
    """Return all settings by name, including those of `occupancy`."""
    found = msgspec.structs.asdict(settings)
    return {**msgspec.structs.asdict(found.pop("occupancy")), **found}


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
    unknown
        Damaged databases that were put aside, and why, where nothing says what else they had; until that is
        forgotten on purpose.
    damaged
        Numbers of damaged rows, which stay as they are and do not count.
    boot
        Since which start of the machine the database's log is written: only the end of that loses what was
        not flushed.
    """

    format: int
    map_id: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{32}$")]
    settings: MapSettings
    mappers: Annotated[list[Mapper], msgspec.Meta(max_length=MAPPERS)] = []
    next_mapper: Annotated[int, msgspec.Meta(ge=1, le=1 << 53)] = 1
    runs: Annotated[int, msgspec.Meta(ge=0, lt=(1 << 31) - 1)] = msgspec.field(default=0, name="lives")
    applied: dict[int, Count] = {}
    lost: dict[str, Lost] = {}
    unknown: dict[str, str] = {}
    damaged: list[Count] = []
    boot: str = ""

    def __post_init__(self) -> None:
        numbers = {one.number for one in self.mappers}
        if len(numbers) < len(self.mappers) or max(numbers, default=0) >= self.next_mapper:
            raise ValueError("two mappers have one number, or one has a number that was not given yet")
        for text in self.lost:
            ChunkKey.from_text(text)

    @property
    def lost_chunks(self) -> dict[ChunkKey, Lost]:
        """The lost chunks by their keys."""
        return {ChunkKey.from_text(text): one for text, one in self.lost.items()}


def boot_id() -> str:
    """Return the id of this start of the machine."""
    return Path("/proc/sys/kernel/random/boot_id").read_text().strip()


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
    return decode_map(folder.read(MAP_FILE), MAP_FILE, formats=(OLD_FORMAT, MAP_FORMAT))


def decode_map(data: bytes | str, path: str, *, formats: tuple[int, ...] = (MAP_FORMAT,)) -> MapRecord:
    """Return a record that is as it was written; else raise `MapDataError`."""
    found = decoded(data, _map_record, path)
    if found.format not in formats:
        raise MapDataError(f"format {found.format}; this reads {MAP_FORMAT}", path=path)
    return found

# SPDX-License-Identifier: Apache-2.0
"""The files in the directory of a live map: their names, ``map.json``, ``manifest.json``, headers of chunks.

All reads of the directory use this module; ``map_files.py`` explains the files' purpose.  Reading is bounded
whatever a file contains, and invalid content raises `MapDataError`.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Mapping
from typing import Annotated, Final, NamedTuple, TypeAlias, TypeVar

import msgspec

from shmmap.chunks.chunk_file import FILE_HEADER_BYTES, ChunkFileHeader, read_file_header
from shmmap.chunks.layout import MAPPERS, MAX_FRAME_BYTES, ChunkIdentity
from shmmap.chunks.layout import MAX_BYTES as MAX_CHUNK_BYTES
from shmmap.chunks.occupancy import Occupancy
from shmmap.chunks.voxels import ChunkKey
from shmmap.daemon.live.disk.folder import DAMAGED, INTERIM, MAX_BYTES, Folder, FolderToRead, replace_file
from shmmap.errors import BadRequest, ConfigError, MapDataError

__all__ = [
    "CHUNK",
    "MANIFEST",
    "MAP_FILE",
    "MAP_FORMAT",
    "FileNames",
    "Listed",
    "Manifest",
    "MapRecord",
    "MapSettings",
    "Mapper",
    "Row",
    "read_chunk",
    "read_header",
    "read_manifest",
    "read_map",
    "write_rows",
]

_T = TypeVar("_T")

MAP_FILE: Final = "map.json"
MANIFEST: Final = "manifest.json"
MAP_FORMAT: Final = 1
CHUNK: Final = ".chunk"
"""Suffix of the files of chunks."""

_MAX_CHUNK_FILE_BYTES: Final = 2 * MAX_CHUNK_BYTES
"""Maximum length of a chunk's file: incompressible content becomes slightly longer."""
_MAX_MAP_BYTES: Final = 1 << 20
_MAX_MANIFEST_BYTES: Final = MAX_BYTES - 1
"""Maximum length of ``map.json`` and of ``manifest.json``: about two million chunks."""
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
    """Data about a chunk's file that is known without opening it."""

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


class MapRecord(msgspec.Struct):
    """Content of ``map.json``."""

    format: int
    map_id: str
    settings: MapSettings
    mappers: list[Mapper] = []
    next_mapper: Annotated[int, msgspec.Meta(ge=1, le=1 << 53)] = 1
    runs: Annotated[int, msgspec.Meta(ge=0, lt=(1 << 31) - 1)] = msgspec.field(default=0, name="lives")


class Manifest(msgspec.Struct):
    """Content of ``manifest.json``.

    Attributes
    ----------
    chunks
        The durable chunks.
    applied
        For each mapper's number, the last scan up to which at least all are durable.
    missing
        Chunks of which something was lost, as they were listed: a file was quarantined, or is gone.
    """

    format: int
    chunks: dict[str, Row]
    applied: dict[int, Count] = {}
    missing: dict[str, Row] = {}


class FileNames(NamedTuple):
    """The files in the directory of a live map, by kind.

    Attributes
    ----------
    chunks
        By key, in the order of the keys.
    strange
        Files named like chunks, but with impossible keys.
    interim
        Files still under interim names.
    quarantined
        Damaged or unreadable files that were given other names.
    """

    everything: list[str]
    chunks: dict[ChunkKey, str]
    strange: list[str]
    interim: list[str]
    quarantined: list[str]

    @classmethod
    def of(cls, names: Iterable[str]) -> FileNames:
        """Sort names by kind of file."""
        found = cls(sorted(names), {}, [], [], [])
        chunks: dict[ChunkKey, str] = {}
        for name in found.everything:
            if name.startswith(".") and name.endswith(INTERIM):
                found.interim.append(name)
            elif DAMAGED in name and name.rpartition(".")[2].isdecimal():
                found.quarantined.append(name)
            elif name.endswith(CHUNK):
                try:
                    chunks[ChunkKey.from_text(name.removesuffix(CHUNK))] = name
                except BadRequest:
                    found.strange.append(name)
        found.chunks.update(sorted(chunks.items()))
        return found

    @property
    def of_map(self) -> list[str]:
        """The map's own files, in the order in which they may be removed or moved.

        If the process is killed in between, a valid live map remains.  So the manifest, which would report
        chunks as missing, is removed first, and ``map.json``, without which chunks are meaningless, last.
        """
        own = (f".{MAP_FILE}.", f".{MANIFEST}.")
        interim = [name for name in self.interim if name.startswith(own) or f"{CHUNK}." in name]
        others = [*self.chunks.values(), *self.strange, *self.quarantined, *interim]
        there = set(self.everything)
        first, last = [MANIFEST] if MANIFEST in there else [], [MAP_FILE] if MAP_FILE in there else []
        return [*first, *sorted(others), *last]


def _whole(files: FolderToRead, name: str, most: int) -> bytes:
    """Return a whole file of at most ``most`` bytes; raise as `read_map`."""
    data = files.read(name, most + 1)
    if len(data) > most:
        raise MapDataError(f"it has more than {most:,} bytes", path=name, cause="too_long")
    return data


def read_chunk(files: FolderToRead, name: str) -> bytes:
    """Return the whole file of a chunk, unchecked; raise as `read_map`."""
    return _whole(files, name, _MAX_CHUNK_FILE_BYTES)


def read_header(files: FolderToRead, name: str, path: str = "") -> ChunkFileHeader:
    """Return the header of a chunk's file, which errors call ``path``; raise as `read_map`."""
    return read_file_header(files.read(name, FILE_HEADER_BYTES), path or name)


# created once, here: msgspec crashes if several threads decode a type for the first time concurrently
_map_record: Final = msgspec.json.Decoder(MapRecord)
_manifest: Final = msgspec.json.Decoder(Manifest)


def _decoded(data: bytes, decoder: msgspec.json.Decoder[_T], name: str) -> _T:
    try:
        return decoder.decode(data)
    except _NOT_DECODED as error:
        reason = str(error) or type(error).__name__
        raise MapDataError(f"it is damaged: {reason}", path=name) from error


def read_map(files: FolderToRead) -> MapRecord:
    """Read ``map.json``.

    Raises
    ------
    MapDataError
        The file is damaged or invalid.
    OSError
        It cannot be read.
    """
    found = _decoded(_whole(files, MAP_FILE, _MAX_MAP_BYTES), _map_record, MAP_FILE)
    if found.format != MAP_FORMAT:
        raise MapDataError(f"format {found.format}; this reads {MAP_FORMAT}", path=MAP_FILE)
    numbers = [one.number for one in found.mappers]
    least, most = _RESOLUTION_M
    for is_right, what in (
        (_MAP_ID.fullmatch(found.map_id), "map_id is not 32 hexadecimal digits"),
        (least <= found.settings.resolution <= most, f"resolution {found.settings.resolution!r}"),
        (0 < len(found.settings.frame_id.encode()) <= MAX_FRAME_BYTES, "frame_id is empty or too long"),
        (len(numbers) <= MAPPERS, f"{len(numbers)} mappers; {MAPPERS} are the most"),
        (len(set(numbers)) == len(numbers), "two mappers have one number"),
        (max(numbers, default=0) < found.next_mapper, "a mapper has a number that was not given yet"),
    ):
        if not is_right:
            raise MapDataError(f"it is damaged: {what}", path=MAP_FILE)
    return found


class Listed(NamedTuple):
    """What the manifest lists; attributes as in `Manifest`."""

    chunks: dict[ChunkKey, Row]
    applied: dict[int, int]
    missing: dict[ChunkKey, Row]

    def lost(self, rows: Mapping[ChunkKey, Row]) -> dict[ChunkKey, Row]:
        """Return, of what was listed, the chunks of which these rows of good files lack something."""
        found = {
            key: row for key, row in self.chunks.items() if key not in rows or rows[key].version < row.version
        }
        return {**found, **{key: row for key, row in self.missing.items() if rows.get(key) != row}}


def read_manifest(files: FolderToRead) -> Listed:
    """Read ``manifest.json``.

    Raises
    ------
    MapDataError
        The file is damaged or invalid.
    OSError
        The file cannot be read; FileNotFoundError if there is none.
    """
    found = _decoded(_whole(files, MANIFEST, _MAX_MANIFEST_BYTES), _manifest, MANIFEST)
    if found.format != MAP_FORMAT:
        raise MapDataError(f"format {found.format}; this reads {MAP_FORMAT}", path=MANIFEST)
    try:
        chunks, missing = (
            {ChunkKey.from_text(text): row for text, row in rows.items()}
            for rows in (found.chunks, found.missing)
        )
    except BadRequest as error:
        raise MapDataError(f"it is damaged: {error.message}", path=MANIFEST) from error
    return Listed(chunks, found.applied, missing)


def write_rows(files: Folder, listed: Listed) -> None:
    """Write the manifest."""
    chunks, missing = (
        {key.text: row for key, row in rows.items()} for rows in (listed.chunks, listed.missing)
    )
    replace_file(files, MANIFEST, msgspec.json.encode(Manifest(MAP_FORMAT, chunks, listed.applied, missing)))
    files.sync_names()

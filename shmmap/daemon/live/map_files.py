# SPDX-License-Identifier: Apache-2.0
"""A live map on disk: what it is, who maps it, and a file for each of its chunks.

- ``map.json`` says what the map is, and never forgets a mapper's number; it is on the disk before any of
  that is used.
- ``3_-1_0.chunk`` is a chunk (``shmmap/chunks/CHUNKS.md``).  It is written under another name; from then on
  no death of a process loses it, and its memory may be freed.  `MapFiles.flush` has it on the disk, then in
  the place of an older one, and then it is *durable*.  Until that its bytes are kept, in case that the disk
  fails, and for whoever loads it again: what is written often is flushed seldom.
- ``manifest.json`` lists the chunks that are durable.  It is written last, and only says what somebody may
  have taken away; all else is read from the chunks' headers.
- What is damaged is put aside as ``3_-1_0.chunk.damaged.1``, named, and never overwritten.  What the system
  does not let be read may be good: then the map cannot be opened, and nothing of it is changed.
"""

from __future__ import annotations

import contextlib
import secrets
from collections.abc import Iterator
from typing import Final

import msgspec

from shmmap.chunks.chunk_file import FILE_HEADER_BYTES, ChunkFileHeader, check_file, read_file_header
from shmmap.chunks.voxels import ChunkKey
from shmmap.daemon.live.disk.map_record import (
    CHUNK,
    MANIFEST,
    MAP_FILE,
    MAP_FORMAT,
    Mapper,
    MapRecord,
    MapSettings,
    Row,
    keys_of,
    read_chunk,
    read_manifest,
    read_map,
    write_rows,
)
from shmmap.daemon.live.folder import INTERIM, Files, keep_aside, replace_file
from shmmap.daemon.live.unflushed_files import UnflushedFiles
from shmmap.errors import ConfigError, MapDataError
from shmmap.failpoints import step
from shmmap.logfmt import log

__all__ = ["MapFiles", "MapSettings", "Mapper", "Row"]

SCANS_AHEAD: Final = 1 << 20
"""Numbers of scans that ``map.json`` leaves to a mapper before it is written again: a day's, at 10 Hz."""


class MapFiles:
    """The files of one live map.

    Parameters
    ----------
    files
        Of a directory that is this map's alone.
    settings
        What a new map is to be; an old one must be the same.

    Attributes
    ----------
    rows : dict
        The chunks on disk.
    damaged : dict
        Files that were put aside since the start, and why.
    missing : dict
        Chunks that were durable and are not there any more, or only in an older version.
    applied : dict
        Up to which scan of each mapper, by its number, all are durable, as far as the manifest says.

    Raises
    ------
    ConfigError
        The map was made with other settings.
    MapDataError
        ``map.json`` is not what it should be, or is missing although there are chunks.
    OSError
        A file cannot be read or written.
    """

    def __init__(self, files: Files, settings: MapSettings) -> None:
        self.files = files
        self.rows: dict[ChunkKey, Row] = {}
        self.damaged: dict[str, str] = {}
        self.missing: dict[ChunkKey, Row] = {}
        self._unflushed = UnflushedFiles(files)
        self.applied: dict[int, int] = {}
        self._durable: dict[ChunkKey, Row] = {}
        self._begun = False
        names = files.names()
        if MAP_FILE in names:
            with _named(MAP_FILE):
                self._map = self._read_map(settings)
        elif any(name.endswith(CHUNK) for name in names):
            raise MapDataError(
                "there are chunks, but the file that says what they are is missing",
                path=MAP_FILE, hint="choose another directory, or bring the file back",
            )  # fmt: skip
        else:
            self._map = MapRecord(MAP_FORMAT, secrets.token_hex(16), settings)
            self._write_map()
        self._adopt_interim(names)
        self._read_rows()

    # --- what the map is ------------------------------------------------------------------------

    @property
    def map_id(self) -> bytes:
        """16 bytes that no other map has."""
        return bytes.fromhex(self._map.map_id)

    @property
    def settings(self) -> MapSettings:
        """What was fixed when it was made."""
        return self._map.settings

    @property
    def mappers(self) -> list[Mapper]:
        """Who maps, the one that was first heard of first."""
        return self._map.mappers

    def begin_life(self) -> int:
        """Return how many times the map was in memory, this time included; on disk when this returns."""
        if not self._begun:
            self._map.lives += 1
            self._write_map()
            self._begun = True
        return self._map.lives

    def add_mapper(self, uid: int, name: str) -> Mapper:
        """Give a new mapper its number; it is on the disk when this returns."""
        mapper = Mapper(self._map.next_mapper, uid, name)
        self._map.next_mapper += 1
        before, self._map.mappers = self._map.mappers, [*self._map.mappers, mapper]
        try:
            self._write_map()
        except OSError:
            self._map.mappers = before
            raise
        return mapper

    def forget_mapper(self, mapper: Mapper) -> None:
        """A mapper gives way; nobody gets its number."""
        before, self._map.mappers = self._map.mappers, [one for one in self._map.mappers if one is not mapper]
        try:
            self._write_map()
        except OSError:
            self._map.mappers = before
            raise

    def expect_scan(self, mapper: Mapper, scan: int) -> None:
        """Make sure that the disk knows that a mapper's scans may have come to this number."""
        if scan >= (before := mapper.scans):
            mapper.scans = scan + SCANS_AHEAD
            try:
                self._write_map()
            except OSError:
                mapper.scans = before
                raise

    def _read_map(self, settings: MapSettings) -> MapRecord:
        found = read_map(self.files)
        old_ones, new_ones = _flat(found.settings), _flat(settings)
        for name, new in new_ones.items():
            if (old := old_ones[name]) != new:
                raise ConfigError(
                    f"{name} = {new!r}: the map was made with {old!r}",
                    key=name, hint="leave it as it was, or choose another directory for a new map",
                )  # fmt: skip
        return found

    def _write_map(self) -> None:
        text = msgspec.json.format(msgspec.json.encode(self._map), indent=1)
        replace_file(self.files, MAP_FILE, text + b"\n")
        self.files.sync_names()
        step("live.map")

    # --- chunks ---------------------------------------------------------------------------------

    def version(self, key: ChunkKey) -> int:
        """Version of a chunk's file; 0 where there is none."""
        row = self.rows.get(key)
        return row.version if row is not None else 0

    def load(self, key: ChunkKey) -> bytes | None:
        """Read the file of a chunk; None where there is none.  Raises OSError, and MapDataError."""
        if key not in self.rows:
            return None
        unflushed = self._unflushed.get(key)
        return unflushed if unflushed is not None else read_chunk(self.files, key.text + CHUNK)

    def put_aside(self, key: ChunkKey, why: str) -> str:
        """Keep a file that cannot be read under another name, which is returned."""
        name = self._put_aside(key.text + CHUNK, why)
        self.rows.pop(key, None)
        self._durable.pop(key, None)
        return name

    def _put_aside(self, name: str, why: str) -> str:
        aside = keep_aside(self.files, name)
        self.damaged[aside] = why
        log.error("file of a live map quarantined", file=aside, reason=why)
        return aside

    def save(self, key: ChunkKey, data: bytes) -> None:
        """Write the file of a chunk, which takes the place of an older one and is durable after `flush`.

        When this returns, the chunk's memory may be freed: no death of a process loses it.
        """
        row = Row.of(read_file_header(data))
        self._unflushed.write(key, data)
        self.rows[key] = row

    def flush(self) -> None:
        """Make durable what was saved; what comes meanwhile is for the next time."""
        for key, data in self._unflushed.flush().items():
            self._durable[key] = Row.of(read_file_header(data))

    @property
    def unflushed_bytes(self) -> int:
        """What is written and not durable takes so much memory here."""
        return self._unflushed.nbytes

    def remove_spare(self) -> None:
        """Remove what is only there to be written over."""
        self._unflushed.remove_spare()

    def write_manifest(self, applied: dict[int, int] | None = None) -> None:
        """Make durable what was saved, and list it.

        ``applied`` says up to which scan of each mapper all are durable; None where it is not known.
        """
        self.flush()
        if applied is not None:
            self.applied = applied
        write_rows(self.files, dict(self._durable), self.applied)

    # --- the start ------------------------------------------------------------------------------

    def _header(self, name: str, *, whole: bool = False) -> ChunkFileHeader | None:
        """What a file of this map says of its chunk, if its length is right, and, if ``whole``, its body."""
        with contextlib.suppress(FileNotFoundError, MapDataError):
            if whole:
                header = check_file(read_chunk(self.files, name), name)
            else:
                header = read_file_header(self.files.read(name, FILE_HEADER_BYTES), name)
            right = self.files.size(name) == FILE_HEADER_BYTES + header.stored_bytes
            if right and header.map_id == self.map_id:
                return header
        return None

    def _adopt_interim(self, names: list[str]) -> None:
        """A file that was written and had not got its name may be the newest of its chunk; others go."""
        for name in names:
            if not (name.startswith(".") and name.endswith(INTERIM)):
                continue
            with _named(name):
                header = self._header(name, whole=True)
                if header is not None:
                    place = header.key.text + CHUNK
                    old = self._header(place)
                    if old is None or old.version < header.version:
                        if old is None and place in names:
                            self.put_aside(header.key, "it cannot be read, and a whole one was beside it")
                        self.files.sync(name)
                        self.files.rename(name, place)
                        continue
                self.files.remove(name)

    def _read_rows(self) -> None:
        """Find the chunks, and what is missing of those that the manifest lists."""
        names = self.files.names()
        found, strange = keys_of(names)
        if strange:
            log.warning("not chunks of this map", files=len(strange), first=min(strange))
        for key, name in found.items():
            with _named(name):
                header = self._header(name)
            if header is None or header.key != key:
                self.put_aside(key, "its header or its length is wrong")
            else:
                self.rows[key] = Row.of(header)
        self.files.sync_names()
        self._durable = dict(self.rows)
        if MANIFEST not in names:
            return
        try:
            with _named(MANIFEST):
                listed, applied = read_manifest(self.files)
        except MapDataError as error:
            self._put_aside(MANIFEST, error.message)  # it is written again
            return
        sent = {mapper.number: mapper.scans for mapper in self.mappers}
        self.applied = {number: scan for number, scan in applied.items() if scan < sent.get(number, 0)}
        for key, row in listed.items():
            if key not in self.rows or self.rows[key].version < row.version:
                self.missing[key] = row
                log.error("chunk missing", chunk=key.text, version=row.version)


@contextlib.contextmanager
def _named(name: str) -> Iterator[None]:
    """Have what the system says of a file name it."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, f"{name} cannot be read: {error.strerror}") from error


def _flat(settings: MapSettings) -> dict[str, object]:
    """All settings by name, those of the occupancy among them."""
    found = msgspec.structs.asdict(settings)
    return {**msgspec.structs.asdict(found.pop("occupancy")), **found}

# SPDX-License-Identifier: Apache-2.0
"""A live map on disk: its settings, its mappers, and a file for each of its chunks.

- ``map.json`` holds the map's settings and every mapper's number; a change is on disk before it is used.
- ``3_-1_0.chunk`` is a chunk (``shmmap/chunks/CHUNKS.md``).  It is first written under another name.  From
  then on no death of a process loses it, and its memory may be freed.  `MapFiles.flush` brings it to the disk
  and then into the place of an older one: now it is *durable*.  Until then its bytes are kept, in case the
  disk fails, and for the next load: a file that is written often is flushed seldom.
- ``manifest.json`` lists the durable chunks.  It is written last, and only serves to detect chunks removed
  since; all other data is read from the chunks' headers.
- A damaged file is quarantined as ``3_-1_0.chunk.damaged.1``, reported, and never overwritten, and its chunk
  is `missing`, as one is whose file is gone.  All who need a saved chunk read it by `MapFiles.load`, so
  whichever of them finds that, all know.  A file that the system does not let this process read may be good:
  at the start the map is then not opened, later the chunk is `unreadable` until it can be read.
"""

from __future__ import annotations

import contextlib
import secrets
import threading
from collections.abc import Iterator
from itertools import chain, islice
from typing import Final

import msgspec

from shmmap.chunks.chunk_file import (
    FILE_HEADER_BYTES,
    ChunkFileHeader,
    check_file,
    decode_chunk,
    read_file_header,
)
from shmmap.chunks.voxels import ChunkKey
from shmmap.daemon.live.disk.folder import Folder, quarantine, replace_file
from shmmap.daemon.live.disk.map_record import (
    CHUNK,
    MANIFEST,
    MAP_FILE,
    MAP_FORMAT,
    FileNames,
    Listed,
    Mapper,
    MapRecord,
    MapSettings,
    Row,
    read_chunk,
    read_header,
    read_manifest,
    read_map,
    write_rows,
)
from shmmap.daemon.live.disk.unflushed_files import UnflushedFiles
from shmmap.errors import ConfigError, MapDataError
from shmmap.failpoints import step
from shmmap.logfmt import log

__all__ = ["MapFiles", "loss_text"]

_LOOKED_AT: Final = 16
_UNKNOWN: Final = Row(0, 0, 0, 0, 0, 0)
SCANS_AHEAD: Final = 1 << 20
"""Scan numbers that ``map.json`` reserves for a mapper at a time: those of a day at 10 Hz."""


class MapFiles:
    """The files of one live map.

    Parameters
    ----------
    files
        Files of the map's own directory.
    settings
        Settings of a new map; an existing map must have the same.

    Attributes
    ----------
    rows : dict
        The chunks on disk.
    damaged : dict
        Files that were quarantined since the start, and why.
    missing : dict
        Chunks of which something that was saved is lost, as they were: the file was quarantined, is gone, or
        is an older one.  They stay here, and in the manifest, when the chunk is mapped again, until the same
        file is back or ``shmmap live fsck --repair`` forgets them.
    unreadable : dict
        Chunks whose files the system does not let this process read at present, and why.
    manifest_is_due : bool
        Whether `missing` has changed since the manifest was last written.
    applied : dict
        For each mapper's number, the last scan up to which all are durable, according to the manifest.

    Raises
    ------
    ConfigError
        The map was made with other settings.
    MapDataError
        ``map.json`` is damaged or invalid, or is missing although there are chunks.
    OSError
        A file cannot be read or written.
    """

    def __init__(self, files: Folder, settings: MapSettings) -> None:
        self.files = files
        self.rows: dict[ChunkKey, Row] = {}
        self.damaged: dict[str, str] = {}
        self.missing: dict[ChunkKey, Row] = {}
        self.unreadable: dict[ChunkKey, str] = {}
        self.manifest_is_due = False
        self._quarantined: set[ChunkKey] = set()
        self._remade: set[ChunkKey] = set()  # missing chunks that memory may have again, without what is lost
        self._changing = threading.Lock()
        self._unflushed = UnflushedFiles(files)
        self.applied: dict[int, int] = {}
        self._durable: dict[ChunkKey, Row] = {}
        self._begun = False
        names = FileNames.of(files.names())
        if MAP_FILE in names.everything:
            with _named(MAP_FILE):
                self._map = self._read_map(settings)
        elif names.chunks or names.strange or MANIFEST in names.everything:
            raise MapDataError(
                "there are chunks, or a list of them, but the file that says what they are is missing",
                path=MAP_FILE,
                hint="choose another directory, or bring the file back",
            )
        else:
            self._map = MapRecord(MAP_FORMAT, secrets.token_hex(16), settings)
            self._write_map()
        self._adopt_interim(names)
        self._read_rows()

    # --- identity and mappers ------------------------------------------------------------------------

    @property
    def map_id(self) -> bytes:
        """Unique id of the map, 16 bytes."""
        return bytes.fromhex(self._map.map_id)

    @property
    def settings(self) -> MapSettings:
        """Settings that were fixed when the map was created."""
        return self._map.settings

    @property
    def mappers(self) -> list[Mapper]:
        """All mappers, the oldest first."""
        return self._map.mappers

    def begin_run(self) -> int:
        """Return the number of runs of the map, this one included; on disk when this returns."""
        if not self._begun:
            self._map.runs += 1
            self._write_map()
            self._begun = True
        return self._map.runs

    def add_mapper(self, uid: int, name: str) -> Mapper:
        """Add a mapper with a new number, which is on disk when this returns."""
        mapper = Mapper(self._map.next_mapper, uid, name)
        self._map.next_mapper += 1
        self._write_mappers([*self.mappers, mapper])
        return mapper

    def forget_mapper(self, mapper: Mapper) -> None:
        """Forget a mapper; its number is not used again."""
        self._write_mappers([one for one in self.mappers if one is not mapper])

    def _write_mappers(self, mappers: list[Mapper]) -> None:
        before, self._map.mappers = self._map.mappers, mappers
        try:
            self._write_map()
        except OSError:
            self._map.mappers = before
            raise

    def expect_scan(self, mapper: Mapper, scan: int) -> None:
        """Record on disk that a mapper's scans may have reached this number."""
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
                    key=name,
                    hint="leave it as it was, or choose another directory for a new map",
                )
        return found

    def _write_map(self) -> None:
        text = msgspec.json.format(msgspec.json.encode(self._map), indent=1)
        replace_file(self.files, MAP_FILE, text + b"\n")
        self.files.sync_names()
        step("live.map")

    # --- chunks ---------------------------------------------------------------------------------

    def version(self, key: ChunkKey) -> int:
        """Return the version of a chunk's file; 0 if there is none."""
        row = self.rows.get(key)
        return row.version if row is not None else 0

    def load(self, key: ChunkKey, generation: int = 0) -> bytearray | None:
        """Return a chunk as it was last saved, with a generation; None if there is no good file.

        A damaged file is quarantined, one that is gone noted: from then on the chunk is `missing`.

        Raises
        ------
        OSError
            The file cannot be read at present, and may be good: the chunk is `unreadable` until it can.
        PackageMissing
            The package for its codec is not installed.
        """
        try:
            found = self._load(key, generation)
        except OSError as error:
            self.unreadable[key] = error.strerror or str(error)
            raise
        self.unreadable.pop(key, None)
        return found

    def _load(self, key: ChunkKey, generation: int) -> bytearray | None:
        with contextlib.suppress(FileNotFoundError, MapDataError):
            return self._read(key, generation)
        with self._unflushed.flushing:  # read again while no other file gets its name
            if (row := self.rows.get(key)) is None:
                return None  # another thread was here
            try:
                return self._read(key, generation)
            except FileNotFoundError:
                self._lose(key, row, "its file is gone")
            except MapDataError as error:
                why = error.message.removeprefix(f"{key.text}: ")
                self._quarantine(key.text + CHUNK, why)
                self._quarantined.add(key)
                self._lose(key, row, why)
        return None

    def _read(self, key: ChunkKey, generation: int) -> bytearray | None:
        if key not in self.rows:
            return None
        data = self._unflushed.get(key)
        if data is None:
            data = read_chunk(self.files, key.text + CHUNK)
        return decode_chunk(data, self.settings.identity(self.map_id, key, generation), key.text)

    def look_again(self) -> None:
        """Try to read some of the chunks that were unreadable."""
        for key in list(self.unreadable)[:_LOOKED_AT]:
            with contextlib.suppress(OSError):
                self.load(key)

    def quarantine(self, key: ChunkKey, why: str) -> str:
        """Rename a chunk's unusable file to a quarantine name; return that name."""
        name = self._quarantine(key.text + CHUNK, why)
        self._quarantined.add(key)
        self._lose(key, self.rows.get(key), why)
        return name

    def _lose(self, key: ChunkKey, row: Row | None, why: str) -> None:
        """Note that a chunk's file, which had this row (None: not known), is of no use any more."""
        with self._changing:
            if self.rows.get(key) is not row:
                return  # saved meanwhile
            self.rows.pop(key, None)
            self._durable.pop(key, None)
            self.missing.setdefault(key, row or _UNKNOWN)
            self.manifest_is_due = True
        log.error("chunk missing", chunk=key.text, version=row.version if row else None, reason=why)

    def note_remade(self, key: ChunkKey) -> None:
        """Note that a chunk is in memory without what its file had, if that is lost."""
        if key in self.missing:
            self._remade.add(key)

    def note_whole(self, key: ChunkKey, version: int) -> None:
        """Note that a chunk is in memory as it was saved, or newer; it is missing no more if it is whole."""
        row = self.missing.get(key)
        if row is not None and key not in self._remade and version >= row.version:
            del self.missing[key]
            self.manifest_is_due = True
            log.info("chunk is whole in memory, and saved again", chunk=key.text)

    def losses(self, most: int) -> tuple[tuple[str, ...], int]:
        """Return texts about quarantined files and other chunks that lost something; and their number."""
        quarantined, missing = dict(self.damaged), dict(self.missing)  # other threads find more
        others = missing.keys() - self._quarantined
        texts = chain(
            (f"{key.text}: {loss_text(missing[key])}" for key in others),
            (f"{name}: {why}" for name, why in quarantined.items()),
        )
        return tuple(islice(texts, most)), len(others) + len(quarantined)

    def _quarantine(self, name: str, why: str) -> str:
        other = quarantine(self.files, name)
        self.damaged[other] = why
        log.error("file of a live map quarantined", file=other, reason=why)
        return other

    def save(self, key: ChunkKey, data: bytes) -> None:
        """Write the file of a chunk, which replaces an older one and is durable after `flush`.

        When this returns, the chunk's memory may be freed: no death of a process loses it.
        """
        row = Row.of(read_file_header(data))
        self._unflushed.write(key, data)
        with self._changing:
            self.rows[key] = row
        self.unreadable.pop(key, None)

    def flush(self) -> None:
        """Make all saved chunks durable; chunks saved meanwhile are left to the next flush."""
        for key, data in self._unflushed.flush().items():
            self._durable[key] = Row.of(read_file_header(data))

    @property
    def unflushed_bytes(self) -> int:
        """Memory of the files that are written but not durable yet, bytes."""
        return self._unflushed.nbytes

    def remove_spare(self) -> None:
        """Remove the spare files, which are only kept to be overwritten."""
        self._unflushed.remove_spare()

    def write_manifest(self, applied: dict[int, int] | None = None) -> None:
        """Make all saved chunks durable, and list them in the manifest.

        ``applied`` has, for each mapper, the last scan up to which all are durable; None if unknown.
        """
        self.flush()
        if applied is not None:
            self.applied = applied
        self.manifest_is_due = False
        write_rows(self.files, Listed(dict(self._durable), self.applied, dict(self.missing)))

    # --- the start ------------------------------------------------------------------------------

    def _header(self, name: str, *, whole: bool = False) -> ChunkFileHeader | None:
        """Return the header of a file of this map; None if its length (``whole``: its body) is wrong."""
        with contextlib.suppress(FileNotFoundError, MapDataError):
            header = (
                check_file(read_chunk(self.files, name), name) if whole else read_header(self.files, name)
            )
            right = self.files.size(name) == FILE_HEADER_BYTES + header.stored_bytes
            if right and header.map_id == self.map_id:
                return header
        return None

    def _adopt_interim(self, names: FileNames) -> None:
        """Give interim files that are the newest of their chunks their final names, and remove the others."""
        for name in names.interim:
            with _named(name):
                header = self._header(name, whole=True)
                if header is not None:
                    place = header.key.text + CHUNK
                    old = self._header(place)
                    if old is None or old.version < header.version:
                        if old is None and place in names.everything:
                            self.quarantine(header.key, "it cannot be read, and a whole one was beside it")
                        self.files.sync(name)
                        self.files.rename(name, place)
                        continue
                elif CHUNK in name and self.files.size(name):
                    log.warning("unfinished file of a live map removed", file=name, reason="it is damaged")
                self.files.remove(name)

    def _read_rows(self) -> None:
        """Find the chunks, and those that the manifest lists but are missing."""
        names = FileNames.of(self.files.names())
        if names.strange:
            log.warning("not chunks of this map", files=len(names.strange), first=min(names.strange))
        for key, name in names.chunks.items():
            with _named(name):
                header = self._header(name)
            if header is None or header.key != key:
                self.quarantine(key, "its header or its length is wrong")
            else:
                self.rows[key] = Row.of(header)
        self.files.sync_names()
        self._durable = dict(self.rows)
        if MANIFEST not in names.everything:
            return
        try:
            with _named(MANIFEST):
                listed = read_manifest(self.files)
        except MapDataError as error:
            self._quarantine(MANIFEST, error.message)  # it is written again
            return
        sent = {mapper.number: mapper.scans for mapper in self.mappers}
        self.applied = {number: scan for number, scan in listed.applied.items() if scan < sent.get(number, 0)}
        lost = listed.lost(self.rows)
        self._remade = listed.missing.keys() & lost.keys()
        for key, row in lost.items():
            if key not in self.missing:
                log.error("chunk missing", chunk=key.text, version=row.version)
        self.missing |= lost


def loss_text(row: Row) -> str:
    """Return what is lost of a chunk that had this row."""
    return f"version {row.version} is missing" if row.version else "what its file had is missing"


@contextlib.contextmanager
def _named(name: str) -> Iterator[None]:
    """Add the file's name to errors of the operating system."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, f"{name} cannot be read: {error.strerror}") from error


def _flat(settings: MapSettings) -> dict[str, object]:
    """Return all settings by name, including those of `occupancy`."""
    found = msgspec.structs.asdict(settings)
    return {**msgspec.structs.asdict(found.pop("occupancy")), **found}

# SPDX-License-Identifier: Apache-2.0
"""A live map on disk: its record, and a row for each of its chunks, in one SQLite database.

A commit is in the kernel when `MapDatabase.save` returns, so no death of a process loses it, and the chunk's
memory may be freed.  `MapDatabase.flush` flushes the database's log: all commits before are *durable*.  When
the log has become long, it is brought into the database.

One connection writes and brings the log in; a second one only reads, beside it.  Nothing else in the process
opens the file: closing a descriptor would drop the locks of both.

A row whose checksum is wrong stays as it is; its chunk is *lost*, by name, and is saved again under another
number.  A database whose tables are damaged is put aside, and one made of its rows (`rebuilding.py`).
"""

from __future__ import annotations

import contextlib
import errno
import os
import sqlite3
import threading
from collections import deque
from collections.abc import Callable
from itertools import chain, islice
from typing import Final, TypeVar

import msgspec

from shmmap.chunks.chunk_file import decode_chunk, read_file_header
from shmmap.chunks.voxels import ChunkKey
from shmmap.errors import MapDataError
from shmmap.failpoints import step
from shmmap.formats.durable_file import appearing_file
from shmmap.live_worker.disk.folder import Folder
from shmmap.live_worker.disk.map_record import (
    MAP_FILE,
    MAP_FORMAT,
    Lost,
    Mapper,
    MapRecord,
    MapSettings,
    Row,
    boot_id,
    check_settings,
    read_map,
)
from shmmap.live_worker.disk.old_directory import put_old_files_aside
from shmmap.live_worker.disk.rebuilding import check_log, make_if_missing, rebuild
from shmmap.live_worker.disk.schema import (
    DATABASE,
    GET_DATA,
    GET_KEY,
    LOG,
    PUT_CHUNK,
    TABLES_DAMAGED,
    check_tables,
    chunk_values,
    connect,
    database_errors,
    read_record,
    read_rows,
    require_local_disk,
    require_log,
    valid_rows,
)
from shmmap.logfmt import log

T = TypeVar("T")

SCANS_AHEAD: Final = 1 << 20
"""Scan numbers that the record reserves for a mapper at a time: those of a day at 10 Hz."""
LOG_BYTES: Final = 16 << 20
"""Length of the log from which it is brought into the database."""
MAX_LOG_BYTES: Final = 64 << 20
"""Length of the log beyond which nothing is saved: another process's reading keeps it from being cut."""
_LOOKED_AT: Final = 16


class MapDatabase:
    """The database of one live map, of which a new run begins.  Usable from any thread.

    Parameters
    ----------
    folder
        The map's own directory.
    settings
        Settings of a new map; an existing map must have the same.

    Attributes
    ----------
    rows : dict
        The chunks on disk.
    found_lost : collections.deque
        Chunks whose saved bytes were lost since this was last emptied.
    damaged : dict
        Databases that were put aside, and why: since the start, and those of the record.
    unreadable : dict
        Chunks that cannot be read from the disk at present, and why.
    record : MapRecord
        Everything about the map but its chunks.  Chunks that lost something stay in it when they are mapped
        again, until ``shmmap live fsck --repair`` forgets them.
    record_is_due : bool
        Whether the lost chunks have changed since the record was last written.

    Raises
    ------
    ConfigError
        The map was made with other settings, or the directory is on a network file system.
    MapDataError
        The record is damaged or invalid, or is missing although there are chunks.
    OSError
        A file cannot be read or written.
    """

    def __init__(self, folder: Folder, settings: MapSettings) -> None:
        self.folder = folder
        self.rows: dict[ChunkKey, Row] = {}
        self.found_lost: deque[ChunkKey] = deque()
        self.damaged: dict[str, str] = {}
        self.unreadable: dict[ChunkKey, str] = {}
        self.record_is_due = False
        self._numbers: dict[ChunkKey, int] = {}
        self._next_number = 1
        # taken in this order; `_changing`, of the dictionaries, is never held while the disk is waited for
        self._writing, self._reading = threading.RLock(), threading.RLock()
        self._logging, self._changing = threading.Lock(), threading.Lock()
        self._writer: sqlite3.Connection | None = None
        self._reader: sqlite3.Connection | None = None
        self._log = -1
        self._identities: dict[str, tuple[int, int] | None] = {}  # of the files that are open
        self._opened = 0  # times that a database was opened
        self._damage = ""
        self._is_closed = self._flush_failed = False
        self.record: MapRecord
        self._has_record = False
        require_local_disk(folder)
        try:
            make_if_missing(folder, settings)
            put_old_files_aside(folder)
            self._open_or_rebuild()
            check_settings(self.record.settings, settings)
            self.record.runs += 1
            self.record.boot = boot_id()
            self._write_map()
        except BaseException:
            self.close()
            raise

    # --- the start ------------------------------------------------------------------------------

    def _open_or_rebuild(self) -> None:
        with self._writing:
            try:
                self._open()
            except MapDataError as error:
                if error.cause != TABLES_DAMAGED:
                    raise
                self._rebuild(error.message)

    def _open(self) -> None:
        """Open the database, and read the record and the rows; raise as `database_errors`."""
        check_log(self.folder)
        with self._reading, database_errors(self.folder), contextlib.ExitStack() as undo:
            undo.callback(self._disconnect)  # else it would not be tried again
            self._writer = connect(self.folder)
            check_tables(self._writer)
            require_log(self._writer, self.folder)
            _cut_log(self._writer)  # nothing is written behind what was dropped from it
            for pragma in ("synchronous = normal", "wal_autocheckpoint = 0", "cell_size_check = on"):
                self._writer.execute(f"pragma {pragma}")
            text = self._writer.execute("select record from map").fetchall()
            self._writer.execute("replace into map values(0, ?)", text[0] if text else ("",))  # makes the log
            self._reader = connect(self.folder, mode="ro")
            if not self._has_record:
                self.record, self._has_record = read_record(self._reader), True
            rows, numbers, last = read_rows(self._reader, self.record)
            self._log = os.open(self.folder.place(LOG), os.O_RDONLY | os.O_CLOEXEC)
            os.fdatasync(self._log)
            self.folder.sync_names()
            self._identities = {name: self.folder.identity(name) for name in (DATABASE, LOG)}
            undo.pop_all()
        with self._changing:
            self.rows, self._numbers, self._next_number = rows, numbers, last + 1
            self.damaged = {**self.record.unknown, **self.damaged}
            self._opened += 1

    def _disconnect(self) -> None:
        with self._reading, self._logging:
            for connection in (self._reader, self._writer):  # the last one brings the log in
                if connection is not None:
                    with contextlib.suppress(sqlite3.Error):
                        connection.close()
            if self._log >= 0:
                os.close(self._log)
            self._reader, self._writer, self._log, self._identities = None, None, -1, {}

    def _rebuild(self, reason: str) -> None:
        """Make a database from what is left of this one; the thread holds `_writing`."""
        self._damage = reason  # until that has succeeded nothing else is done
        with self._reading:
            self._disconnect()
            record = self.record if self._has_record else _copy_of_record(self.folder)
            known = {key: row.version for key, row in self.rows.items()} if self._opened else None
            before = record.lost if record is not None else {}
            self.record, aside = rebuild(self.folder, record, known, reason)
            self._has_record = True
            self._damage = ""
            self.damaged[aside] = reason
            self.record_is_due = True
            for text, one in self.record.lost.items():
                if before.get(text) != one:
                    self.found_lost.append(ChunkKey.from_text(text))
                    log.error("chunk lost", chunk=text, reason=reason)
            self._open()

    def close(self, seconds: float | None = None) -> None:
        """Close the database; wait at most ``seconds`` for a disk that does not answer."""
        closing = threading.Thread(target=self._close, daemon=True, name="live-closing")
        closing.start()
        closing.join(seconds)

    def _close(self) -> None:
        with self._writing:
            self._is_closed = True
            self._disconnect()

    # --- identity and mappers ------------------------------------------------------------------------

    @property
    def map_id(self) -> bytes:
        """Unique id of the map, 16 bytes."""
        return bytes.fromhex(self.record.map_id)

    @property
    def settings(self) -> MapSettings:
        """Settings that were fixed when the map was created."""
        return self.record.settings

    def add_mapper(self, uid: int, name: str) -> Mapper:
        """Add a mapper with a new number, which is on disk when this returns."""
        mapper = Mapper(self.record.next_mapper, uid, name)
        self.record.next_mapper += 1
        self._write_change(self.record, "mappers", [*self.record.mappers, mapper])
        return mapper

    def forget_mapper(self, mapper: Mapper) -> None:
        """Forget a mapper; its number is not used again."""
        left = [one for one in self.record.mappers if one.number != mapper.number]
        self._write_change(self.record, "mappers", left)

    def expect_scan(self, mapper: Mapper, scan: int) -> None:
        """Record on disk that a mapper's scans may have reached this number."""
        if scan >= mapper.scans:
            self._write_change(mapper, "scans", scan + SCANS_AHEAD)

    def _write_change(self, changed: MapRecord | Mapper, name: str, value: object) -> None:
        """Change a part of the record, on disk; it stays as it was if that fails."""
        before = getattr(changed, name)
        setattr(changed, name, value)
        try:
            self._write_map()
        except OSError:
            setattr(changed, name, before)
            raise

    def write_record(self, applied: dict[int, int] | None = None) -> None:
        """Write the record, and make all saved chunks durable.

        ``applied`` has, for each mapper, the last scan up to which all are durable; None if unknown.
        """
        if applied is not None:
            self.record.applied = applied
        self._write_map()

    def _write_map(self) -> None:
        """Write the record and then its copy, durably."""

        def put(writer: sqlite3.Connection) -> bytes:
            with self._changing:
                text = msgspec.json.encode(self.record)
            writer.execute("replace into map values(0, ?)", (text.decode(),))
            return text

        with self._writing:
            self.record_is_due = False
            try:
                text = self._change(put)
                self.flush()
                with appearing_file(self.folder.place(MAP_FILE)) as file:
                    os.fchmod(file.fileno(), 0o600)
                    file.write(msgspec.json.format(text, indent=1) + b"\n")
            except OSError:
                self.record_is_due = True
                raise
        step("live.map")

    # --- chunks ---------------------------------------------------------------------------------

    def version(self, key: ChunkKey) -> int:
        """Return the version of a saved chunk; 0 if there is none."""
        row = self.rows.get(key)
        return row.version if row is not None else 0

    def load(self, key: ChunkKey, generation: int = 0) -> bytearray | None:
        """Return a chunk as it was last saved, with a generation; None if there is no good one: it is `lost`.

        Raises
        ------
        OSError
            It cannot be read at present, and may be good: the chunk is `unreadable` until it can.
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
        opened, row = self._opened, self.rows.get(key)
        if row is None:
            return None
        try:
            data = self._read(GET_DATA, key)
            if data is not None:
                return decode_chunk(data, self.settings.identity(self.map_id, key, generation), key.text)
        except MapDataError as error:
            with self._writing:
                if self._opened == opened and error.cause == TABLES_DAMAGED and not self._has_row(key):
                    self._rebuild(error.message)
                elif self._opened == opened:
                    self._lose(key, row, error.message.removeprefix(f"{key.text}: "))
        return self._load(key, generation)

    def _read(self, query: str, key: ChunkKey) -> bytes | None:
        """Return what a query finds in a chunk's row; None if that is gone, or lost, since."""
        self._reopen()
        with self._reading, database_errors(self.folder), valid_rows():
            if self._reader is None:
                raise OSError(errno.EIO, self._damage or "it is closed")
            if (number := self._numbers.get(key)) is None:
                return None
            ((found,),) = self._reader.execute(query, (number,)).fetchall()
            return found if isinstance(found, bytes) else str(found).encode()

    def _has_row(self, key: ChunkKey) -> bool:
        """Return whether a chunk has its row, whatever the row's other pages are like."""
        try:
            return self._read(GET_KEY, key) == key.text.encode()
        except MapDataError:
            return False

    def look_again(self) -> None:
        """Try to read some of the chunks that were unreadable."""
        for key in list(self.unreadable)[:_LOOKED_AT]:
            with contextlib.suppress(OSError):
                self.load(key)

    def moved(self) -> str:
        """Return what happened to the directory, or to a file of the database, if it is not where it was."""
        with self._writing:
            for name, identity in self._identities.items():
                if self.folder.identity(name) != identity:
                    return f"{name}: it was moved, removed or replaced"
        return self.folder.moved()

    def _lose(self, key: ChunkKey, row: Row, why: str) -> None:
        """Note, on disk, that the saved bytes of a chunk, which had this row, are of no use."""
        with self._changing:
            if self.rows.get(key) is not row:
                return  # saved meanwhile
            del self.rows[key]
            self.record.damaged.append(self._numbers.pop(key))
            self.record.lost.setdefault(key.text, Lost(row.version, why))
            self.found_lost.append(key)
            self.record_is_due = True
        log.error("chunk lost", chunk=key.text, version=row.version, reason=why)
        with contextlib.suppress(OSError):  # then it is due
            self._write_map()

    def note_remade(self, key: ChunkKey) -> None:
        """Note that a chunk is in memory without what was saved, if that is lost."""
        with self._changing:
            one = self.record.lost.get(key.text)
            if one is not None and not one.remade:
                self.record.lost[key.text] = msgspec.structs.replace(one, remade=True)
                self.record_is_due = True

    def note_whole(self, key: ChunkKey, version: int) -> None:
        """Note that a chunk is in memory as it was saved, or newer; it is lost no more if it is whole."""
        with self._changing:
            one = self.record.lost.get(key.text)
            if one is None or one.remade or version < one.version:
                return
            del self.record.lost[key.text]
            self.record_is_due = True
        log.info("chunk is whole in memory, and saved again", chunk=key.text)

    def losses(self, most: int) -> tuple[tuple[str, ...], int]:
        """Return texts about lost chunks and damaged databases; and their number."""
        damaged, lost = dict(self.damaged), dict(self.record.lost)  # other threads find more
        texts = chain(
            (f"{key}: {one.text}: {one.reason}" for key, one in lost.items()),
            (f"{name}: {why}" for name, why in damaged.items()),
        )
        return tuple(islice(texts, most)), len(lost) + len(damaged)

    def save(self, key: ChunkKey, data: bytes) -> None:
        """Save a chunk, which replaces an older version and is durable after `flush`.

        When this returns, the chunk's memory may be freed: no death of a process loses it.
        """
        row = Row.of(read_file_header(data))

        def put(writer: sqlite3.Connection) -> None:
            number = self._numbers.get(key, self._next_number)
            writer.execute(PUT_CHUNK, chunk_values(number, key.text, row, data))
            with self._changing:
                self.rows[key], self._numbers[key] = row, number
                self._next_number = max(self._next_number, number + 1)

        with self._writing:
            if self.record_is_due and key.text in self.record.lost:
                self._write_map()  # else the damaged row would count at the next start
            if self._log_bytes() > MAX_LOG_BYTES:
                self.bring_log_in()
            try:
                self._change(put)
            except OSError as error:
                if error.errno != errno.ENOSPC:
                    raise
                self.bring_log_in()  # which has old versions of chunks
                self._change(put)
        step("live.written")
        self.unreadable.pop(key, None)

    def _change(self, work: Callable[[sqlite3.Connection], T]) -> T:
        """Write to the database; rebuild it if it proves damaged.  The thread holds `_writing`."""
        try:
            return self._with_writer(work)
        except MapDataError as error:
            self._rebuild(error.message)
        return self._with_writer(work)

    def _with_writer(self, work: Callable[[sqlite3.Connection], T]) -> T:
        self._reopen()
        if self._writer is None:
            raise OSError(errno.EIO, "it is closed")
        with database_errors(self.folder):
            return work(self._writer)

    def _reopen(self) -> None:
        """Go on with a rebuild that failed."""
        if self._writer is None and not self._is_closed:
            with self._writing:
                if self._damage:
                    self._rebuild(self._damage)
                elif self._writer is None:
                    self._open_or_rebuild()

    # --- the log ------------------------------------------------------------------------------------

    def flush(self) -> None:
        """Make all saved chunks durable."""
        with self._logging:
            if self._log < 0:
                raise OSError(errno.EIO, self._damage or "it is closed")
            if not (failed := self._flush_failed):
                self._flush_failed = True
                os.fdatasync(self._log)
                self._flush_failed = False
        if failed:  # the kernel takes what it could not write for written: it is written elsewhere
            self.bring_log_in()
            self._flush_failed = False
        step("live.flushed")
        if self._log_bytes() > LOG_BYTES:
            with contextlib.suppress(OSError):  # it grows, and that is tried again
                self.bring_log_in()

    def _log_bytes(self) -> int:
        with self._logging:
            return os.fstat(self._log).st_size if self._log >= 0 else 0

    def bring_log_in(self) -> None:
        """Write what the log has into the database, durably, and cut the log.

        Raises
        ------
        OSError
            The disk is full, or another process has been reading for too long.
        """

        def bring(writer: sqlite3.Connection) -> None:
            writer.execute("pragma wal_checkpoint(passive)").fetchall()  # most of the work, beside reads
            with self._reading:
                _cut_log(writer)

        with self._writing:
            self._change(bring)


def _cut_log(writer: sqlite3.Connection) -> None:
    """Write what the log has into the database, and make the log empty."""
    (busy, _, _) = writer.execute("pragma wal_checkpoint(truncate)").fetchone()
    if busy:
        raise BlockingIOError(errno.EAGAIN, "another process keeps reading its database")


def _copy_of_record(folder: Folder) -> MapRecord | None:
    with contextlib.suppress(MapDataError, FileNotFoundError):
        found = read_map(folder)
        return found if found.format == MAP_FORMAT else None
    return None

# SPDX-License-Identifier: Apache-2.0
"""The tables of a live map's database, how it is opened, and what its errors mean.  See ``CHUNKS.md``."""

from __future__ import annotations

import contextlib
import errno
import os
import sqlite3
from collections.abc import Iterator
from typing import Final

import msgspec

from shmmap.chunks.voxels import ChunkKey
from shmmap.errors import BadRequest, ConfigError, MapDataError
from shmmap.live_worker.disk.folder import FolderToRead, named
from shmmap.live_worker.disk.map_record import MapRecord, Row, decode_map
from shmmap.mounts import REMOTE, mount_of

DATABASE: Final = "map.db"
LOG: Final = "map.db-wal"
SHARED: Final = "map.db-shm"
"""Memory that SQLite shares between the processes that have the database open."""
JOURNAL: Final = "map.db-journal"
"""What SQLite would undo a change by, in a mode in which the database never is."""
TABLES_DAMAGED: Final = "tables"
"""Cause of an error about the whole database, not about one chunk."""
PAGE_BYTES: Final = 4096

_PLENTY: Final = 64 << 20
"""Free bytes of a disk that is not full."""
_APPLICATION: Final = 0x53484D4C
_FORMAT: Final = 1
_PRAGMAS: Final = f"""\
pragma page_size = {PAGE_BYTES};
pragma application_id = {_APPLICATION};
pragma user_version = {_FORMAT};
"""
_TABLES: Final = """\
create table map(id integer primary key, record)
create table chunks(id integer primary key, key, version, bytes, active, occupied, free, bricks, padding, \
data)
create index names on chunks(key, version)
"""
GET_DATA: Final = "select data from chunks where id = ?"
GET_KEY: Final = "select key from chunks where id = ?"
PUT_CHUNK: Final = "replace into chunks values(?, ?, ?, ?, ?, ?, ?, ?, zeroblob(?), ?)"
_CHUNKS: Final = "select id, key, version, bytes, active, occupied, free, bricks from chunks not indexed"
_NAMES: Final = "select distinct key from chunks indexed by names"

_MAX_LOCAL: Final = PAGE_BYTES - 35
_MIN_LOCAL: Final = (PAGE_BYTES - 12) * 32 // 255 - 23
_OVERFLOW: Final = PAGE_BYTES - 4
_WANTED_LOCAL: Final = 816
"""Bytes of a row on its leaf of which five have no room there: a damaged leaf costs four chunks."""
_OTHER_COLUMNS: Final = (16, 96)
"""Least and most bytes of a row apart from its padding and its data."""


def local_bytes(nbytes: int) -> int:
    """Return how many bytes of a row of this length are on its leaf; the others are in a chain of pages."""
    if nbytes <= _MAX_LOCAL:
        return nbytes
    local = _MIN_LOCAL + (nbytes - _MIN_LOCAL) % _OVERFLOW
    return local if local <= _MAX_LOCAL else _MIN_LOCAL


def padding(data: bytes) -> int:
    """Return the bytes of padding with which at most four rows fit on a leaf."""
    least, most = _OTHER_COLUMNS
    local = _MIN_LOCAL + (len(data) + least - _MIN_LOCAL) % _OVERFLOW
    fits = _WANTED_LOCAL <= local <= _MAX_LOCAL - (most - least)
    return 0 if fits else (_WANTED_LOCAL - local) % _OVERFLOW


def chunk_values(number: int, key: str, row: Row, data: bytes) -> tuple[object, ...]:
    """Return the values for `PUT_CHUNK`."""
    return number, key, *msgspec.structs.astuple(row), padding(data), data


def require_local_disk(folder: FolderToRead) -> None:
    """Refuse a directory on a network file system, where processes do not share the log's index.

    Raises
    ------
    ConfigError
        It is on one.
    """
    kind = mount_of(folder.path).kind
    if kind in REMOTE:
        raise ConfigError(
            f"{folder.path} is on a network file system ({kind}), which a live map's database cannot use",
            key="path",
            hint="choose a directory on a disk of this machine",
        )


def require_own_files(folder: FolderToRead) -> None:
    """Refuse what is no regular file, and a journal, from which SQLite would overwrite pages.

    Raises
    ------
    MapDataError
        There is a journal.
    OSError
        A file is not regular.
    """
    for name in (DATABASE, LOG, SHARED):
        with named(name):
            folder.require_regular(name)
    if JOURNAL in folder.names():
        raise MapDataError(
            "no daemon makes it: another program was changing the database, or it is of another one",
            path=JOURNAL,
            hint="move it away; or let the `sqlite3` program open the database, if that made it",
        )


def connect(folder: FolderToRead, name: str = DATABASE, *, mode: str = "rw") -> sqlite3.Connection:
    """Open a database in a directory, wherever that was moved; raise as `database_errors` converts.

    Other processes are never waited for: what is locked is an error, and tried again later.
    """
    path = f"file:{folder.place(name)}?mode={mode}"
    return sqlite3.connect(path, timeout=0, isolation_level=None, check_same_thread=False, uri=True)


def check_tables(database: sqlite3.Connection) -> None:
    """Check that a database is that of a live map, in a format that this reads; raise `MapDataError`."""
    (application,), (found,) = (
        database.execute(f"pragma {name}").fetchone() for name in ("application_id", "user_version")
    )
    if application != _APPLICATION:
        raise MapDataError("it is no live map's database", path=DATABASE, cause=TABLES_DAMAGED)
    if found != _FORMAT:
        raise MapDataError(f"format {found}; this reads {_FORMAT}", path=DATABASE)


def require_log(database: sqlite3.Connection, folder: FolderToRead) -> None:
    """Have a log for a database; raise `ConfigError` where SQLite cannot."""
    (mode,) = database.execute("pragma journal_mode = wal").fetchone()
    if mode != "wal":
        raise ConfigError(
            f"{folder.path}: SQLite cannot keep a log there (journal_mode {mode})",
            key="path",
            hint="choose a directory on a disk of this machine",
        )


def read_record(database: sqlite3.Connection) -> MapRecord:
    """Return the map's record; raise `MapDataError` if it is damaged."""
    try:
        ((text,),) = database.execute("select record from map").fetchall()
        return decode_map(text, DATABASE)
    except (TypeError, ValueError, MapDataError) as error:
        raise MapDataError(f"its record is damaged: {error}", path=DATABASE, cause=TABLES_DAMAGED) from error


def read_rows(
    database: sqlite3.Connection, record: MapRecord
) -> tuple[dict[ChunkKey, Row], dict[ChunkKey, int], int]:
    """Return the rows of the chunks and their numbers, without lost ones, and the greatest number of all.

    Raises
    ------
    MapDataError
        A row is invalid, or one is missing that the index names.
    """
    rows: dict[ChunkKey, Row] = {}
    numbers: dict[ChunkKey, int] = {}
    damaged = set(record.damaged)
    last = 0
    with valid_rows():
        for number, text, *counts in database.execute(_CHUNKS).fetchall():
            last = max(last, number)
            if number not in damaged:  # of several rows of one chunk the last one counts
                key = ChunkKey.from_text(text)
                rows[key] = msgspec.convert(dict(zip(Row.__struct_fields__, counts, strict=True)), Row)
                numbers[key] = number
        for (text,) in database.execute(_NAMES).fetchall():
            if text not in record.lost:
                rows[ChunkKey.from_text(text)]
    return rows, numbers, last


@contextlib.contextmanager
def valid_rows() -> Iterator[None]:
    """Convert errors of rows that are missing or invalid to `MapDataError`."""
    try:
        yield
    except (BadRequest, msgspec.ValidationError, ValueError, TypeError, KeyError) as error:
        raise MapDataError(
            "its tables are damaged: a row is missing or invalid", path=DATABASE, cause=TABLES_DAMAGED
        ) from error


def make_tables(database: sqlite3.Connection) -> None:
    """Create the tables of a new database, within a transaction that is begun here."""
    database.executescript(f"pragma journal_mode = memory; pragma synchronous = off; {_PRAGMAS}")
    database.execute("begin")
    for statement in _TABLES.splitlines():
        database.execute(statement)


@contextlib.contextmanager
def database_errors(folder: FolderToRead) -> Iterator[None]:
    """Convert errors of SQLite.

    Raises
    ------
    MapDataError
        The tables are damaged (cause `TABLES_DAMAGED`): only a rebuilt database can be used.
    OSError
        The disk is full, does not answer well, or another process has locked the database.
    """
    try:
        yield
    except sqlite3.DatabaseError as error:
        text = str(error)
        if "locked" in text:
            raise OSError(errno.EAGAIN, "another process has locked its database") from error
        disk = os.statvfs(folder.place(""))
        free = disk.f_bavail * disk.f_frsize
        if (
            not isinstance(error, sqlite3.OperationalError)
            or any(word in text for word in ("no such", "decode"))
            or ("full" in text and free > _PLENTY)  # a damaged page has a number that no page can have
        ):
            raise MapDataError(
                f"its tables are damaged: {text}", path=DATABASE, cause=TABLES_DAMAGED
            ) from error
        if "full" in text or not free:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)) from error
        number = errno.EROFS if "readonly" in text else errno.EIO
        if "unable to open" in text and not os.access(folder.place(DATABASE), os.R_OK | os.W_OK):
            number = errno.EACCES
        raise OSError(number, f"{os.strerror(number)} ({text})") from error

# SPDX-License-Identifier: Apache-2.0
"""Make a live map's database: a new one, one from an old directory, or one from a damaged one.

It is complete and on the disk before it gets its name.
"""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import chain
from typing import Final, NamedTuple

import msgspec

from shmmap.chunks.chunk_file import ChunkFileHeader, check_file
from shmmap.chunks.voxels import ChunkKey
from shmmap.errors import BadRequest, MapDataError
from shmmap.failpoints import step
from shmmap.live_worker.disk.folder import DAMAGED, INTERIM, MAX_BYTES, Folder, FolderToRead, free_name, named
from shmmap.live_worker.disk.map_record import (
    MAP_FILE,
    MAP_FORMAT,
    OLD_FORMAT,
    Lost,
    MapRecord,
    MapSettings,
    Row,
    boot_id,
    check_settings,
    decode_map,
    read_map,
)
from shmmap.live_worker.disk.old_directory import Chunks, old_files, read_old_chunks
from shmmap.live_worker.disk.salvage import NO_LOG, Log, Pages, Values, index_entries, table_rows
from shmmap.live_worker.disk.schema import (
    DATABASE,
    LOG,
    PUT_CHUNK,
    SHARED,
    TABLES_DAMAGED,
    chunk_values,
    connect,
    database_errors,
    make_tables,
    read_record,
    require_log,
    require_own_files,
)
from shmmap.logfmt import log

NEW: Final = "map.db.new"
"""Name of a database until it is complete."""
_CHUNK_COLUMNS: Final = 10
_MAP_COLUMNS: Final = 2


def make_database(
    folder: Folder, record: MapRecord, chunks: Iterable[tuple[ChunkKey, Row, bytes]] = ()
) -> None:
    """Write a database under its interim name, durably.

    Parameters
    ----------
    record
        Written after all chunks, whose iterator may change it.

    Raises
    ------
    OSError
        The disk is full, or fails.
    """
    remove_unfinished(folder)
    try:
        folder.create(NEW)
        with database_errors(folder), contextlib.closing(connect(folder, NEW)) as database:
            make_tables(database)
            for number, (key, row, data) in enumerate(chunks, 1):
                database.execute(PUT_CHUNK, chunk_values(number, key.text, row, data))
            database.execute("insert into map values(0, ?)", (msgspec.json.encode(record).decode(),))
            database.execute("commit")
            require_log(database, folder)  # from the first on: it never has a journal
        folder.sync(NEW)
    except Exception:
        remove_unfinished(folder)  # a full disk has its room back
        raise


def remove_unfinished(folder: Folder) -> None:
    """Remove a database that was not completed."""
    for name in (NEW, f"{NEW}-wal", f"{NEW}-shm", f"{NEW}-journal"):
        folder.remove(name)


def put_in_place(folder: Folder) -> None:
    """Give a complete database its name; the log of the one that had it is not there any more."""
    folder.rename(NEW, DATABASE)
    folder.sync_names()
    step("live.renamed")


def replace_database(folder: Folder, aside: str) -> None:
    """Put a database and its log aside, and the complete new one in its place.

    A kill in between leaves no database, never one without its log: `finish_replacing` does the rest.
    """
    for name, kept in ((DATABASE, aside), (LOG, f"{aside}-wal")):
        with contextlib.suppress(FileNotFoundError):
            folder.rename(name, kept)
        folder.sync_names()
    folder.remove(SHARED)
    put_in_place(folder)


def asides(folder: FolderToRead) -> list[str]:
    """Return the names of damaged databases that were put aside."""
    start = DATABASE + DAMAGED
    names = (name for name in folder.names() if name.startswith(start))
    return sorted(name for name in names if name[len(start) :].isdecimal())


def finish_replacing(folder: Folder) -> bool:
    """Do the rest of what a kill interrupted; return whether there was anything to do."""
    names = folder.names()
    if DATABASE in names or NEW not in names or not (damaged := asides(folder)):
        return False
    replace_database(folder, max(damaged, key=lambda name: os.stat(folder.place(name)).st_ctime_ns))
    return True


def make_if_missing(folder: Folder, settings: MapSettings) -> None:
    """Make a database if there is none: for a new map, or from an old directory."""
    names = set(folder.names())
    require_own_files(folder)
    with named(MAP_FILE):
        folder.require_regular(MAP_FILE)
    for name in names:
        if name.startswith(f".{MAP_FILE}.") and name.endswith(INTERIM):
            folder.remove(name)
    if DATABASE in names or finish_replacing(folder):
        return
    record = MapRecord(MAP_FORMAT, secrets.token_hex(16), settings)
    chunks: Chunks = iter(())
    if MAP_FILE in names:
        with named(MAP_FILE):
            record = read_map(folder)
        if record.format != OLD_FORMAT:
            raise MapDataError(
                f"{MAP_FILE} is there, but the database with the chunks is missing",
                path=DATABASE,
                hint="bring the file back from a copy; or have `shmmap live reset` put the rest aside",
            )
        check_settings(record.settings, settings)
        log.info("live map of an earlier version is imported", path=folder.path)
        chunks = read_old_chunks(folder, record)
    elif old_files(names):
        raise MapDataError(
            "there are chunks, or a list of them, but the file that says what they are is missing",
            path=MAP_FILE,
            hint="choose another directory, or bring the file back",
        )
    make_database(folder, record, chunks)
    put_in_place(folder)


# --- the log ------------------------------------------------------------------------------------


def check_log(folder: FolderToRead) -> None:
    """Check that SQLite would read the whole log of a database, and that this is its log.

    Raises
    ------
    MapDataError
        It would not (cause `TABLES_DAMAGED`).  Opening the database would then make that lasting.
    """
    _, reason = _checked_log(folder)
    if reason:
        raise MapDataError(reason, path=DATABASE, cause=TABLES_DAMAGED)


def _checked_log(folder: FolderToRead) -> tuple[Log, str]:
    """Return what counts of the log, and what is wrong with it."""
    try:
        found = Log(min(folder.size(LOG), MAX_BYTES), partial(folder.read, LOG))
    except FileNotFoundError:
        return NO_LOG, ""
    if _is_foreign(folder, found):
        return NO_LOG, "its log is of another map"
    # a daemon that runs has its own index of the frames, and goes on
    if not folder.is_in_use() and found.is_damaged(was_cut=not _is_same_boot(folder)):
        return found, "a page of its log is damaged"
    return found, ""


def _is_foreign(folder: FolderToRead, found: Log) -> bool:
    """Return whether a log has rows of another map."""
    for _, values in table_rows(Pages(None, found, found.count)):
        if (record := _record_of(values)) is not None:
            return _map_id(folder) not in ("", record.map_id)
        if (chunk := _chunk_of(values)) is not None:
            return _map_id(folder) not in ("", chunk[0].map_id.hex())
    return False


def _map_id(folder: FolderToRead) -> str:
    """Return a map's id, as the database has it without its log, or the copy of its record."""
    with (
        contextlib.suppress(OSError, MapDataError),
        database_errors(folder),
        contextlib.closing(connect(folder, mode="ro&immutable=1")) as database,
    ):
        return read_record(database).map_id
    with contextlib.suppress(OSError, MapDataError):
        return read_map(folder).map_id
    return ""


def _is_same_boot(folder: FolderToRead) -> bool:
    with contextlib.suppress(OSError, MapDataError):
        return read_map(folder).boot == boot_id()
    return False


# --- what is left -------------------------------------------------------------------------------


class Salvage(NamedTuple):
    """What is left of a damaged database.

    Attributes
    ----------
    rows
        The newest good version of each chunk: its row, and the row's number.
    names
        Chunks that the index names, with their newest versions.
    record
        The map's record; None if it is damaged.
    """

    rows: dict[ChunkKey, tuple[Row, int]]
    names: dict[ChunkKey, int]
    record: MapRecord | None


def salvage(folder: FolderToRead) -> Salvage:
    """Read what is left.

    No connection of this process may be open: closing a descriptor would drop its locks.
    """
    with _opened(folder) as versions:
        return _salvage(versions, "")


def _salvage(versions: Sequence[Pages], map_id: str) -> Salvage:
    """Read what is left; ``map_id`` is that of the chunks that count, empty for all."""
    rows: dict[ChunkKey, tuple[Row, int]] = {}
    names: dict[ChunkKey, int] = {}
    record = None
    for number, values in chain.from_iterable(map(table_rows, versions)):
        if (chunk := _chunk_of(values)) is not None:
            key, row = chunk[0].key, Row.of(chunk[0])
            if map_id in ("", chunk[0].map_id.hex()) and (
                key not in rows or (rows[key][1], rows[key][0].version) < (number, row.version)
            ):
                rows[key] = row, number
        else:
            record = _record_of(values) or record
    for entry in chain.from_iterable(map(index_entries, versions)):
        with contextlib.suppress(BadRequest, ValueError, TypeError, AttributeError):
            text, version, _ = entry
            key = ChunkKey.from_text(text)
            names[key] = max(names.get(key, 0), int(version))
    return Salvage(rows, names, record)


def rebuild(
    folder: Folder, record: MapRecord | None, known: Mapping[ChunkKey, int] | None, reason: str
) -> tuple[MapRecord, str]:
    """Make a database from what is left of a damaged one, and put that aside; return its name there.

    No connection of this process may be open.

    Parameters
    ----------
    record
        The map's record, if it is known; it gets the chunks that are lost.
    known
        Versions of the chunks that were saved; None for those that the index names.

    Raises
    ------
    MapDataError
        The record is damaged, and not known.
    OSError
        The disk is full, or fails: the damaged database is as it was.
    """
    with _opened(folder) as versions:
        found = _salvage(versions, record.map_id if record is not None else "")
        record = record or found.record
        if record is None:
            raise MapDataError(f"{reason}; so is the copy of its record", path=DATABASE)
        lost = dict(record.lost)
        for key, version in (found.names if known is None else known).items():
            if key not in found.rows or found.rows[key][0].version < version:
                lost[key.text] = Lost(version, reason)
        aside, unknown = free_name(folder, DATABASE + DAMAGED), dict(record.unknown)
        if known is None and versions[-1].is_cut:
            unknown[aside] = reason
        made = msgspec.structs.replace(record, lost=lost, unknown=unknown, damaged=[])
        make_database(folder, made, _chunks(versions, found))
    replace_database(folder, aside)
    record.lost, record.unknown, record.damaged = lost, unknown, []  # until here all of it can be done again
    log.error(
        "database of a live map rebuilt", kept=aside, chunks=len(found.rows), lost=len(lost), reason=reason
    )
    return record, aside


def _chunks(versions: Sequence[Pages], found: Salvage) -> Iterator[tuple[ChunkKey, Row, bytes]]:
    """Yield the chunks that were found, each once."""
    left = dict(found.rows)
    for number, values in chain.from_iterable(map(table_rows, versions)):
        if (chunk := _chunk_of(values)) is not None:
            header, data = chunk
            row = Row.of(header)
            if left.get(header.key) == (row, number):
                del left[header.key]
                yield header.key, row, data


def _chunk_of(values: Values) -> tuple[ChunkFileHeader, bytes] | None:
    """Return the header and the bytes of a chunk, if these values are one's and it is whole."""
    if len(values) == _CHUNK_COLUMNS and isinstance(data := values[-1], bytes):
        with contextlib.suppress(MapDataError):
            return check_file(data), data
    return None


def _record_of(values: Values) -> MapRecord | None:
    """Return a map's record, if these values are one and it is whole."""
    if len(values) == _MAP_COLUMNS and isinstance(values[1], str):
        with contextlib.suppress(MapDataError):
            return decode_map(values[1], DATABASE)
    return None


@contextlib.contextmanager
def _opened(folder: FolderToRead) -> Iterator[list[Pages]]:
    """Open a database as SQLite reads it; and with all of its log, where SQLite would drop a part of that."""
    folder.require_regular(DATABASE)
    found, reason = _checked_log(folder)
    frames = [found.read, found.count] if reason else [found.read]
    fd = os.open(folder.place(DATABASE), os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
    try:
        yield [Pages(fd, found, number) for number in frames]
    finally:
        os.close(fd)

# SPDX-License-Identifier: Apache-2.0
"""Make a live map's database: a new one, one from an old directory, or one from a damaged one.

It is complete and on the disk before it gets its name.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final, NamedTuple

import msgspec

from shmmap.chunks.chunk_file import check_file
from shmmap.chunks.voxels import ChunkKey
from shmmap.errors import BadRequest, MapDataError
from shmmap.failpoints import step
from shmmap.live_worker.disk.folder import DAMAGED, Folder, FolderToRead, free_name
from shmmap.live_worker.disk.map_record import Lost, MapRecord, Row, decode_map
from shmmap.live_worker.disk.salvage import Pages, index_entries, table_rows
from shmmap.live_worker.disk.schema import (
    DATABASE,
    LOG,
    PUT_CHUNK,
    SHARED,
    chunk_values,
    connect,
    database_errors,
    make_tables,
    require_log,
)
from shmmap.live_worker.disk.stored_map import asides
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
        folder.write(NEW, b"")  # for this user alone
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
        with contextlib.suppress(FileNotFoundError):
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
    with contextlib.suppress(FileNotFoundError):
        folder.remove(SHARED)
    put_in_place(folder)


def finish_replacing(folder: Folder) -> bool:
    """Do the rest of what a kill interrupted; return whether there was anything to do."""
    names = folder.names()
    if DATABASE in names or NEW not in names or not (damaged := asides(folder)):
        return False
    replace_database(folder, max(damaged, key=lambda name: os.stat(folder.place(name)).st_ctime_ns))
    return True


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


def salvage(folder: FolderToRead, map_id: bytes | None) -> Salvage:
    """Read what is left; ``map_id`` is that of the chunks that count, None for all.

    No connection of this process may be open: closing a descriptor would drop its locks.
    """
    with _opened(folder) as pages:
        return _salvage(pages, map_id)


def _salvage(pages: Pages, map_id: bytes | None) -> Salvage:
    rows: dict[ChunkKey, tuple[Row, int]] = {}
    names: dict[ChunkKey, int] = {}
    record = None
    for number, values in table_rows(pages):
        if (chunk := _good_chunk(values, map_id)) is not None:
            key, row, _ = chunk
            if key not in rows or (rows[key][1], rows[key][0].version) < (number, row.version):
                rows[key] = row, number
        elif len(values) == _MAP_COLUMNS and isinstance(values[1], str):
            with contextlib.suppress(MapDataError):
                record = decode_map(values[1], DATABASE)
    for entry in index_entries(pages):
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
    with _opened(folder) as pages:
        found = _salvage(pages, bytes.fromhex(record.map_id) if record is not None else None)
        record = record or found.record
        if record is None:
            raise MapDataError(f"{reason}; so is the copy of its record", path=DATABASE)
        lost = dict(record.lost_chunks)
        for key, version in (found.names if known is None else known).items():
            if key not in found.rows or found.rows[key][0].version < version:
                lost[key] = Lost(version, reason)
        record.lost = {key.text: one for key, one in lost.items()}
        record.damaged = []
        make_database(folder, record, _chunks(pages, found))
    aside = free_name(folder, DATABASE + DAMAGED)
    replace_database(folder, aside)
    log.error(
        "database of a live map rebuilt", kept=aside, chunks=len(found.rows), lost=len(lost), reason=reason
    )
    return record, aside


def _chunks(pages: Pages, found: Salvage) -> Iterator[tuple[ChunkKey, Row, bytes]]:
    """Yield the chunks that were found, each once."""
    left = dict(found.rows)
    for number, values in table_rows(pages):
        if (chunk := _good_chunk(values, None)) is not None and left.get(chunk[0]) == (chunk[1], number):
            del left[chunk[0]]
            yield chunk


def _good_chunk(values: list[Any], map_id: bytes | None) -> tuple[ChunkKey, Row, bytes] | None:
    """Return the key, the row and the bytes of a chunk, if these values are one's and it is whole."""
    if len(values) != _CHUNK_COLUMNS or not isinstance(data := values[-1], bytes):
        return None
    try:
        header = check_file(data)
    except MapDataError:
        return None
    return (header.key, Row.of(header), data) if map_id in (None, header.map_id) else None


@contextlib.contextmanager
def _opened(folder: FolderToRead) -> Iterator[Pages]:
    with contextlib.ExitStack() as closing:
        descriptors = []
        for name in (DATABASE, LOG):
            folder.require_regular(name)
            with contextlib.suppress(FileNotFoundError):
                descriptors.append(os.open(folder.place(name), os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW))
                closing.callback(os.close, descriptors[-1])
        yield Pages(descriptors[0], descriptors[1] if len(descriptors) > 1 else None)

# SPDX-License-Identifier: Apache-2.0
"""Check the database of a live map, repair what can be repaired, and reset the whole map."""

from __future__ import annotations

import contextlib
import os
from typing import Literal

import msgspec

from shmmap.chunks.voxels import ChunkKey
from shmmap.errors import MapDataError
from shmmap.formats.durable_file import flush_directory
from shmmap.live_worker.disk.folder import Folder, FolderToRead, free_name
from shmmap.live_worker.disk.map_record import MAP_FILE, Lost, MapRecord, Row, read_map
from shmmap.live_worker.disk.old_directory import old_files
from shmmap.live_worker.disk.rebuilding import Salvage, asides, check_log, rebuild, salvage
from shmmap.live_worker.disk.schema import DATABASE, LOG, SHARED, TABLES_DAMAGED, connect, database_errors
from shmmap.live_worker.disk.stored_map import StoredMap


class LostChunk(msgspec.Struct, frozen=True):
    """A chunk of which something is lost.

    Attributes
    ----------
    version
        Version that was saved; 0 if unknown.
    found
        Version that is on disk now; 0 for none.
    """

    chunk: str
    version: int
    found: int
    reason: str


class CheckedMap(msgspec.Struct):
    """Result of a check.

    Attributes
    ----------
    resolution
        Edge of a voxel, metres.
    rows
        The good chunks.
    damaged
        What is wrong with the database's tables; empty if nothing is.
    lost
        Chunks of which something that was saved is lost: damaged now, or found so before.
    aside
        Damaged databases that were put aside.
    unknown
        Those of them of which nothing says what else they had, and why they were put aside.
    rebuilt_from
        Name of the database that a repair put aside; empty without one.
    """

    path: str
    map_id: str
    resolution: float
    frame_id: str
    rows: dict[ChunkKey, Row]
    damaged: str
    lost: list[LostChunk]
    aside: list[str]
    unknown: dict[str, str]
    rebuilt_from: str = ""

    @property
    def good(self) -> bool:
        """Whether all that was saved is on disk, undamaged."""
        return not (self.damaged or self.lost or self.unknown)

    def total(self, what: Literal["bytes", "active", "occupied", "free", "bricks"]) -> int:
        """Return the sum over the good chunks."""
        return sum(getattr(row, what) for row in self.rows.values())


def check(folder: FolderToRead, path: str) -> CheckedMap:
    """Read every chunk completely, without changing anything; other processes may be using the database.

    Raises
    ------
    MapDataError
        The record is damaged, and so is its copy; or the database cannot be read.
    PackageMissing
        A chunk is compressed by a package that is not installed.
    """
    try:
        with contextlib.closing(StoredMap(folder, path)) as stored:
            rows, lost = dict(stored.rows), dict(stored.lost)
            for key, row in stored.rows.items():
                try:
                    stored.chunk(key)
                except MapDataError as error:  # noqa: PERF203  the next one may be good
                    if error.cause == "unreadable":
                        raise
                    del rows[key]
                    lost[key] = Lost(row.version, error.message.removeprefix(f"{error.path}: "))
            map_id, settings, unknown, damaged = stored.map_id.hex(), stored.settings, stored.unknown, ""
    except MapDataError as error:
        if error.cause != TABLES_DAMAGED:
            raise
        damaged = error.message.removeprefix(f"{path}: ")
        found, record = _salvaged(folder, error)
        rows = {key: row for key, (row, _) in found.rows.items()}
        lost = record.lost_chunks
        for key, version in found.names.items():
            if key not in rows or rows[key].version < version:
                lost[key] = Lost(version, damaged)
        map_id, settings, unknown = record.map_id, record.settings, record.unknown
    return CheckedMap(
        path,
        map_id,
        settings.resolution,
        settings.frame_id,
        rows,
        damaged,
        [
            LostChunk(key.text, one.version, rows[key].version if key in rows else 0, one.reason)
            for key, one in sorted(lost.items())
        ],
        asides(folder),
        unknown,
    )


def _salvaged(folder: FolderToRead, why: MapDataError) -> tuple[Salvage, MapRecord]:
    """Return what is left of a database, and the map's record: of that, or its copy."""
    found = salvage(folder)
    record = found.record
    with contextlib.suppress(OSError, MapDataError):
        record = record or read_map(folder)
    if record is None:
        raise why
    return found, record


def repair(folder: Folder, found: CheckedMap) -> None:
    """Make a database of the good chunks, which names none that is lost; put the old one aside.

    ``found`` is updated.  Nothing is deleted.

    Raises
    ------
    OSError
        The disk is full, or fails.
    """
    if found.good:
        return
    _, record = _salvaged(folder, MapDataError("the record is damaged", path=found.path))
    record.lost, record.unknown = {}, {}
    _, found.rebuilt_from = rebuild(folder, record, {}, found.damaged or "chunks are lost")


class ResetMap(msgspec.Struct, frozen=True):
    """Result of a reset: number and bytes of the files, and where they are now; empty if deleted."""

    path: str
    moved_to: str
    files: int
    bytes: int


def files_of_map(folder: FolderToRead) -> dict[str, int]:
    """Return the sizes of the map's own files, in the order in which they may be removed.

    If the process is killed in between, a valid live map remains: the database goes last, or ``map.json``,
    without which the files of an earlier version are meaningless.
    """
    names = folder.names()
    own = (DATABASE + ".", f".{MAP_FILE}.", LOG, SHARED)
    others = sorted(name for name in names if name.startswith(own))
    last = [name for name in (MAP_FILE, DATABASE) if name in names]
    return {name: folder.size(name) for name in [*old_files(names), *others, *last]}


def reset(folder: Folder, *, delete: bool) -> ResetMap:
    """Move the files of a live map into a directory within its own, or delete them.

    Parameters
    ----------
    folder
        The map's directory, locked by this process.
    delete
        Delete them instead of moving them.

    Raises
    ------
    OSError
        A file cannot be moved or deleted.
    """
    if DATABASE in folder.names():
        with contextlib.suppress(OSError, MapDataError), database_errors(folder):
            check_log(folder)
            with contextlib.closing(connect(folder)) as database:
                database.execute("pragma wal_checkpoint(truncate)").fetchall()  # without its log it is older
    sizes = files_of_map(folder)
    aside = "" if delete else free_name(folder, "reset.")
    if aside:
        os.mkdir(folder.place(aside), mode=0o700)
    for name in sizes:
        if aside:
            folder.rename(name, f"{aside}/{name}")
            flush_directory(folder.place(aside))
        else:
            folder.remove(name)
        folder.sync_names()
    return ResetMap(
        folder.path, os.path.join(folder.path, aside) if aside else "", len(sizes), sum(sizes.values())
    )

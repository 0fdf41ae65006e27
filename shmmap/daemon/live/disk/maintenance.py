# SPDX-License-Identifier: Apache-2.0
"""Check the files of a live map, repair what can be repaired, and reset the whole map."""

from __future__ import annotations

import os
from itertools import count
from typing import Literal

import msgspec

from shmmap.chunks.voxels import ChunkKey
from shmmap.daemon.live.disk.folder import Folder, FolderToRead, quarantine
from shmmap.daemon.live.disk.map_record import (
    CHUNK,
    MANIFEST,
    MAP_FILE,
    FileNames,
    Listed,
    Row,
    read_header,
    write_rows,
)
from shmmap.daemon.live.disk.stored_map import StoredMap
from shmmap.errors import MapDataError
from shmmap.formats.durable_file import flush_directory

__all__ = [
    "CheckedMap",
    "DamagedFile",
    "MissingChunk",
    "ResetMap",
    "check",
    "files_of_map",
    "repair",
    "reset",
]


class DamagedFile(msgspec.Struct):
    """A damaged file; ``kept_as`` is its name in quarantine, empty if it is not quarantined."""

    file: str
    reason: str
    kept_as: str = ""


class MissingChunk(msgspec.Struct, frozen=True):
    """A chunk whose saved ``version`` is lost; ``found`` is the version on disk now, 0 for none."""

    chunk: str
    version: int
    found: int


class CheckedMap(msgspec.Struct):
    """Result of a check.

    Attributes
    ----------
    resolution
        Edge of a voxel, metres.
    rows
        The good chunks.
    unreadable
        Files that this process may not read, or that are not regular, with the reason: they may be undamaged.
        `repair` quarantines them, too.
    missing
        Chunks of which something is lost: the manifest lists a version for which there is no file, or that a
        daemon lost, whatever was mapped there since.
    manifest
        ``stale`` if its list of chunks differs from the files, as after a daemon was killed.
    interim
        Files still under interim names: the daemon takes over the good ones at its next start.
    quarantined
        Files that were quarantined before.
    strange
        Files named like chunks, but with impossible keys.
    rewritten
        Whether a new manifest was written.
    """

    path: str
    map_id: str
    resolution: float
    frame_id: str
    rows: dict[ChunkKey, Row]
    damaged: list[DamagedFile]
    unreadable: dict[str, str]
    missing: list[MissingChunk]
    manifest: Literal["current", "stale", "absent", "unreadable"]
    interim: list[str]
    quarantined: list[str]
    strange: list[str]
    rewritten: bool = False

    @property
    def good(self) -> bool:
        """Whether all that was saved is on disk, undamaged."""
        return not (self.damaged or self.unreadable or self.missing or self.manifest == "unreadable")

    def total(self, what: Literal["bytes", "active", "occupied", "free", "bricks"]) -> int:
        """Return the sum over the good chunks."""
        return sum(getattr(row, what) for row in self.rows.values())


def check(files: FolderToRead, path: str) -> CheckedMap:
    """Read every chunk completely, without changing anything; other processes may be using the files.

    Raises
    ------
    MapDataError
        ``map.json`` is damaged or invalid.
    PackageMissing
        A chunk is compressed by a package that is not installed.
    """
    stored = StoredMap(files, path)
    listed = stored.listed
    rows: dict[ChunkKey, Row] = {}
    damaged: list[DamagedFile] = []
    unreadable: dict[str, str] = {}
    for key, name in stored.chunks.items():
        row = _row_or_error(stored, key)
        if isinstance(row, Row):
            rows[key] = row
            continue
        reason = row.message.removeprefix(f"{row.path}: ")
        if row.cause == "unreadable":
            unreadable[name] = reason
        elif row.cause != "missing":  # removed since the names were listed
            damaged.append(DamagedFile(name, reason))
    known = {one.file for one in damaged} | unreadable.keys()
    interim = []
    for name in stored.names.interim:
        try:
            if not _is_spare(files, name, rows):
                interim.append(name)
        except OSError as error:  # noqa: PERF203  the next file may be readable
            unreadable[name] = f"it cannot be read: {error.strerror}"
    return CheckedMap(
        path=path,
        map_id=stored.map_id.hex(),
        resolution=stored.settings.resolution,
        frame_id=stored.settings.frame_id,
        rows=rows,
        damaged=damaged,
        unreadable=unreadable,
        missing=_missing(listed.lost(rows), rows, known) if listed is not None else [],
        manifest=(
            ("current" if listed.chunks == rows else "stale")
            if listed is not None
            else "unreadable"
            if stored.manifest_error
            else "absent"
        ),
        interim=interim,
        quarantined=stored.names.quarantined,
        strange=stored.names.strange,
    )


def _is_spare(files: FolderToRead, name: str, rows: dict[ChunkKey, Row]) -> bool:
    """Return whether a file is only a spare: its chunk's own file is as new.  Raise OSError."""
    try:
        header = read_header(files, name)
    except (FileNotFoundError, MapDataError):
        return False
    return header.key in rows and rows[header.key].version >= header.version


def _row_or_error(stored: StoredMap, key: ChunkKey) -> Row | MapDataError:
    try:
        header, _ = stored.chunk(key)
    except MapDataError as error:
        return error
    return Row.of(header)


def _missing(lost: dict[ChunkKey, Row], rows: dict[ChunkKey, Row], known: set[str]) -> list[MissingChunk]:
    return [
        MissingChunk(key.text, row.version, rows[key].version if key in rows else 0)
        for key, row in lost.items()
        if key.text + CHUNK not in known
    ]


def repair(files: Folder, found: CheckedMap) -> None:
    """Quarantine files that are damaged or cannot be read, and list the good ones in a new manifest.

    ``found`` is updated: all quarantined files are then in ``damaged``, with their new names.  No other
    process may have changed the files since the check.  Nothing is deleted.

    Raises
    ------
    OSError
        A file cannot be renamed or written.
    """
    found.damaged += [DamagedFile(name, reason) for name, reason in found.unreadable.items()]
    found.unreadable = {}
    if found.manifest == "unreadable":
        found.damaged.append(DamagedFile(MANIFEST, "it cannot be read, or does not list chunks"))
    for one in found.damaged:
        one.kept_as = quarantine(files, one.file)
    if found.manifest != "current" or found.missing:
        # a program that replays its scans restores the damaged chunks
        write_rows(files, Listed(found.rows, {}, {}))
        found.rewritten = True


class ResetMap(msgspec.Struct, frozen=True):
    """Result of a reset: number and bytes of the files, and where they are now; empty if deleted."""

    path: str
    moved_to: str
    files: int
    bytes: int


def files_of_map(files: FolderToRead) -> dict[str, int]:
    """Return the sizes of the map's own files, in the order in which they may be removed."""
    return {name: files.size(name) for name in FileNames.of(files.names()).of_map}


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
    sizes = files_of_map(folder)
    aside = ""
    if not delete:
        taken = set(folder.names())
        name = next(one for number in count(1) if (one := f"reset.{number}") not in taken)
        aside = os.path.join(folder.path, name)
        os.mkdir(aside, mode=0o700)
    for name in sizes:
        if delete:
            folder.remove(name)
        else:
            folder.rename(name, os.path.join(os.path.basename(aside), name))
        if name in {MANIFEST, MAP_FILE}:
            _sync(folder, aside)
    _sync(folder, aside)
    return ResetMap(folder.path, aside, len(sizes), sum(sizes.values()))


def _sync(folder: Folder, aside: str) -> None:
    if aside:
        flush_directory(aside)
    folder.sync_names()

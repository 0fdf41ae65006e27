# SPDX-License-Identifier: Apache-2.0
"""Whether all files of a live map are as they were written, and what can be done where they are not."""

from __future__ import annotations

from typing import Literal

import msgspec

from shmmap.chunks.chunk_file import FILE_HEADER_BYTES, read_file_header
from shmmap.chunks.voxels import ChunkKey
from shmmap.daemon.live.disk.map_record import CHUNK, MANIFEST, Row, read_manifest, write_rows
from shmmap.daemon.live.disk.stored_map import StoredMap
from shmmap.daemon.live.folder import INTERIM, Files, FilesToRead, keep_aside
from shmmap.errors import MapDataError

__all__ = ["CheckedMap", "DamagedFile", "MissingChunk", "check", "repair"]


class DamagedFile(msgspec.Struct):
    """A chunk's file that is not as it was written.

    Attributes
    ----------
    file
        Its name.
    reason
        What is wrong.
    kept_as
        The name under which it was put aside; empty if it was not.
    """

    file: str
    reason: str
    kept_as: str = ""


class MissingChunk(msgspec.Struct, frozen=True):
    """A chunk that was on the disk and is not there any more, or only as it was before.

    Attributes
    ----------
    chunk
        Its key.
    version
        Which state of it was on the disk.
    found
        Which one is there now, 0 for none.
    """

    chunk: str
    version: int
    found: int


class CheckedMap(msgspec.Struct):
    """What was found.

    Attributes
    ----------
    path, map_id, resolution, frame_id
        Which map; metres.
    rows
        The chunks that are good.
    damaged
        Those that are not.
    unreadable
        Files that the system does not let this process read, or that are no regular ones, and why: they may
        be good.  `repair` quarantines them, too.
    missing
        What the manifest lists beyond the files.
    manifest
        ``stale`` is one that does not have the chunks as the files have them: that of a daemon that was
        killed is.
    interim
        Files that were not given their names: the daemon's next start takes the good ones over.
    aside
        Files that were put aside before.
    strange
        Files called as those of chunks are, which no chunk can have.
    rewritten
        The manifest was written anew.
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
    aside: list[str]
    strange: list[str]
    rewritten: bool = False

    @property
    def good(self) -> bool:
        """Whether everything that was saved is there."""
        return not (self.damaged or self.unreadable or self.missing or self.manifest == "unreadable")

    def total(self, what: Literal["bytes", "active", "occupied", "free", "bricks"]) -> int:
        """Sum over the good chunks."""
        return sum(getattr(row, what) for row in self.rows.values())


def check(files: FilesToRead, path: str) -> CheckedMap:
    """Read every chunk whole; nothing is changed, and others may be working with the files.

    Raises
    ------
    MapDataError
        ``map.json`` is not what it should be.
    PackageMissing
        A chunk is compressed by a package that is not installed.
    """
    listed = _listed(files)  # before the files, which only get newer
    stored = StoredMap(files, path)
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
        elif row.cause != "missing":  # since the names were listed
            damaged.append(DamagedFile(name, reason))
    known = {one.file for one in damaged} | unreadable.keys()
    interim = []
    for name in stored.names:
        if name.startswith(".") and name.endswith(INTERIM):
            try:
                if not _is_older(files, name, rows):
                    interim.append(name)
            except OSError as error:
                unreadable[name] = f"it cannot be read: {error.strerror}"
    return CheckedMap(
        path=path,
        map_id=stored.map_id.hex(),
        resolution=stored.settings.resolution,
        frame_id=stored.settings.frame_id,
        rows=rows,
        damaged=damaged,
        unreadable=unreadable,
        missing=_missing(listed, rows, known) if isinstance(listed, dict) else [],
        manifest=("current" if listed == rows else "stale") if isinstance(listed, dict) else listed,
        interim=interim,
        aside=stored.aside,
        strange=stored.strange,
    )


def _is_older(files: FilesToRead, name: str, rows: dict[ChunkKey, Row]) -> bool:
    """Whether a file is only there to be written over: its chunk's own is as new.  Raises OSError."""
    try:
        header = read_file_header(files.read(name, FILE_HEADER_BYTES))
    except (FileNotFoundError, MapDataError):
        return False
    return header.key in rows and rows[header.key].version >= header.version


def _row_or_error(stored: StoredMap, key: ChunkKey) -> Row | MapDataError:
    try:
        header, _ = stored.chunk(key)
    except MapDataError as error:
        return error
    return Row.of(header)


def _listed(files: FilesToRead) -> dict[ChunkKey, Row] | Literal["absent", "unreadable"]:
    """The chunks that the manifest lists."""
    try:
        return read_manifest(files)[0]
    except FileNotFoundError:
        return "absent"
    except (OSError, MapDataError):
        return "unreadable"


def _missing(listed: dict[ChunkKey, Row], rows: dict[ChunkKey, Row], known: set[str]) -> list[MissingChunk]:
    found = {key: rows[key].version if key in rows else 0 for key in listed}
    return [
        MissingChunk(key.text, row.version, found[key])
        for key, row in listed.items()
        if row.version > found[key] and key.text + CHUNK not in known
    ]


def repair(files: Files, found: CheckedMap) -> None:
    """Quarantine files that are damaged or cannot be read, and list the good ones in a new manifest.

    What was done is noted in ``found``: all that was quarantined is ``damaged`` then, with its new name.

    Nobody else may work with the files since they were checked.  Nothing is deleted.

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
        one.kept_as = keep_aside(files, one.file)
    if found.manifest != "current":
        write_rows(files, found.rows, {})  # who plays scans again brings back what was damaged
        found.rewritten = True

# SPDX-License-Identifier: Apache-2.0
"""The directory of a live map until 0.3, in which each chunk was a file: what importing it reads.

- ``map.json`` is the map's record, as now, of format 1.
- ``3_-1_0.chunk`` is a chunk (``shmmap/chunks/CHUNKS.md``); files whose names begin with a dot and end in
  ``.tmp`` are chunks that were not flushed yet, or older ones.  The newest good one of each chunk counts.
- ``manifest.json`` lists the chunks that were durable, and those that were lost: it reveals what is missing.
- ``*.damaged.<number>`` was found damaged and put aside.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterable, Iterator
from itertools import count
from typing import Final

import msgspec

from shmmap.chunks.chunk_file import FILE_HEADER_BYTES, check_file, read_file_header
from shmmap.chunks.voxels import ChunkKey
from shmmap.errors import BadRequest, MapDataError
from shmmap.live_worker.disk.folder import Folder, FolderToRead, named
from shmmap.live_worker.disk.map_record import (
    MAP_FILE,
    MAP_FORMAT,
    OLD_FORMAT,
    Count,
    Lost,
    MapRecord,
    Row,
    decoded,
    read_map,
)
from shmmap.logfmt import log

MANIFEST: Final = "manifest.json"
CHUNK: Final = ".chunk"
IMPORTED: Final = "imported."
"""Directory, with a number, into which imported files are moved."""
_CHUNK_FILE: Final = re.compile(r".*\.chunk|(\..*)?\.chunk\..*\.tmp")
_OTHER_FILE: Final = re.compile(
    r"manifest\.json(\.damaged\..*)?|\.manifest\.json\..*\.tmp|.*\.chunk\.damaged\..*"
)


class _Manifest(msgspec.Struct):
    """Content of ``manifest.json``; ``applied`` as in `MapRecord`."""

    format: int
    chunks: dict[str, Row]
    applied: dict[int, Count] = {}
    missing: dict[str, Row] = {}


_manifest: Final = msgspec.json.Decoder(_Manifest)


Chunks = Iterator[tuple[ChunkKey, Row, bytes]]


def old_chunks(names: Iterable[str]) -> list[str]:
    """Return the files that may be chunks, under whatever name."""
    return sorted(filter(_CHUNK_FILE.fullmatch, names))


def old_files(names: Iterable[str]) -> list[str]:
    """Return the files of an old directory but ``map.json``, in the order in which they may be removed.

    The manifest, which would miss others, is the first.
    """
    names = list(names)
    others = sorted(filter(_OTHER_FILE.fullmatch, names), key=lambda name: name != MANIFEST)
    return [*others, *old_chunks(names)]


def read_old_chunks(folder: FolderToRead, record: MapRecord) -> Chunks:
    """Yield the newest good file of each chunk, and then complete the record with what is lost.

    Raises
    ------
    OSError
        A file cannot be read, and may be good.
    """
    candidates: dict[ChunkKey, list[tuple[int, str]]] = {}
    damaged: dict[str, str] = {}
    for name in old_chunks(folder.names()):
        with named(name):
            try:
                header = read_file_header(folder.read(name, FILE_HEADER_BYTES), name)
            except MapDataError as error:
                damaged[name] = error.message
                continue
        if header.map_id == bytes.fromhex(record.map_id):
            if not name.startswith(".") and name != header.key.text + CHUNK:
                damaged[name] = f"it is chunk {header.key.text}"
            candidates.setdefault(header.key, []).append((header.version, name))
        else:
            damaged[name] = "it is of another map"
    rows: dict[ChunkKey, Row] = {}
    for key, names in candidates.items():
        for _, name in sorted(names, reverse=True):
            with named(name):
                data = folder.read(name)
            try:
                rows[key] = Row.of(check_file(data, name))
            except MapDataError as error:
                damaged[name] = error.message
                continue
            yield key, rows[key], data
            break
    record.format = MAP_FORMAT
    record.lost = {key.text: one for key, one in _lost(folder, record, rows, damaged).items()}


def _lost(
    folder: FolderToRead, record: MapRecord, rows: dict[ChunkKey, Row], damaged: dict[str, str]
) -> dict[ChunkKey, Lost]:
    """Return the chunks that were saved, and of which these rows lack something."""
    listed = _read_manifest(folder)
    sent = {mapper.number: mapper.scans for mapper in record.mappers}
    record.applied = {number: scan for number, scan in listed.applied.items() if scan < sent.get(number, 0)}
    found: dict[ChunkKey, Lost] = {}
    for name, reason in damaged.items():
        log.error("file of a live map damaged", file=name, reason=reason)
        with contextlib.suppress(BadRequest):
            key = ChunkKey.from_text(name.removesuffix(CHUNK))
            if key not in rows:
                found[key] = Lost(0, reason)
    for text, row in listed.chunks.items():
        key = ChunkKey.from_text(text)
        if key not in rows or rows[key].version < row.version:
            found[key] = Lost(row.version, found[key].reason if key in found else "its file is gone")
        else:
            found.pop(key, None)  # another file was good
    for text, row in listed.missing.items():
        if rows.get(key := ChunkKey.from_text(text)) != row:
            found[key] = Lost(row.version, "it was lost before", remade=True)
    return found


def _read_manifest(folder: FolderToRead) -> _Manifest:
    nothing = _Manifest(OLD_FORMAT, {})
    if MANIFEST not in folder.names():
        return nothing
    try:
        with named(MANIFEST):
            found = decoded(folder.read(MANIFEST), _manifest, MANIFEST)
        for text in (*found.chunks, *found.missing):
            ChunkKey.from_text(text)
    except (MapDataError, BadRequest) as error:
        log.error("file of a live map damaged", file=MANIFEST, reason=error.message)
        return nothing
    return found


def put_old_files_aside(folder: Folder) -> None:
    """Move the files of an imported directory into one within it, in which they are the map that they were.

    One that a kill interrupted is completed: ``map.json`` is moved last.
    """
    record = [MAP_FILE] if _is_old_record(folder) else []
    names = [*old_files(folder.names()), *record]
    if not names:
        return
    aside = next(one for number in count(1) if _takes(folder, one := f"{IMPORTED}{number}", names))
    with contextlib.suppress(FileExistsError):
        os.mkdir(folder.place(aside), mode=0o700)
    for name in names:
        folder.rename(name, f"{aside}/{name}")
    folder.sync_names()
    log.warning(
        "old files of a live map imported and kept", directory=f"{folder.path}/{aside}", files=len(names)
    )


def _takes(folder: FolderToRead, aside: str, names: list[str]) -> bool:
    """Return whether files may be put into a directory of this name: nothing is replaced there."""
    try:
        return not {MAP_FILE, *names}.intersection(os.listdir(folder.place(aside)))
    except FileNotFoundError:
        return True
    except NotADirectoryError:
        return False


def _is_old_record(folder: FolderToRead) -> bool:
    try:
        return read_map(folder).format == OLD_FORMAT
    except (OSError, MapDataError):
        return False

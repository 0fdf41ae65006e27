# SPDX-License-Identifier: Apache-2.0
"""Read a live map from its files, without changing anything.

A daemon may be using the map meanwhile: each file is replaced as a whole.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

from shmmap.chunks.chunk_file import ChunkFileHeader, check_identity, decode_chunk, read_file_header
from shmmap.chunks.layout import ChunkView
from shmmap.chunks.voxels import ChunkKey
from shmmap.daemon.live.disk.folder import Folder, FolderToRead
from shmmap.daemon.live.disk.map_record import (
    CHUNK,
    MAP_FILE,
    FileNames,
    Listed,
    read_chunk,
    read_header,
    read_manifest,
    read_map,
)
from shmmap.errors import InstanceBusy, MapDataError, MapMissing

__all__ = ["StoredMap", "opened_folder", "opened_folder_to_read"]


class StoredMap:
    """A live map's settings, and its chunks one by one.

    Parameters
    ----------
    path
        Path of the directory in error messages.

    Attributes
    ----------
    map_id, settings
        As in ``map.json``.
    listed
        What the manifest lists; None without one, or if it is damaged (`manifest_error`).
    names, chunks
        All files of the directory, and among them those of chunks, by key.

    Raises
    ------
    MapDataError
        ``map.json`` is damaged or invalid.
    """

    def __init__(self, files: FolderToRead, path: str) -> None:
        self.files = files
        self.path = path
        try:
            try:
                record = read_map(files)
            except OSError as error:
                raise MapDataError(f"it cannot be read: {error.strerror}", path=MAP_FILE) from error
        except MapDataError as error:
            raise MapDataError(
                error.message,
                path=path,
                hint="bring the file back from a copy; or have `shmmap live reset` put the whole map aside",
            ) from error
        self.map_id = bytes.fromhex(record.map_id)
        self.settings = record.settings
        self.listed: Listed | None = None
        self.manifest_error = ""
        try:  # before the files, since files only get newer
            self.listed = read_manifest(files)
        except FileNotFoundError:
            pass
        except (OSError, MapDataError) as error:
            self.manifest_error = (error.strerror or "") if isinstance(error, OSError) else error.message
        self.names = FileNames.of(files.names())
        self.chunks = self.names.chunks

    def header(self, key: ChunkKey) -> ChunkFileHeader:
        """Return the header of a chunk's file; raise as `chunk`."""
        path = self.path_of(key)
        with _reading(path):
            header = read_header(self.files, self.chunks[key], path)
            check_identity(header, self.settings.identity(self.map_id, key, 0), path)
            return header

    def chunk(self, key: ChunkKey) -> tuple[ChunkFileHeader, ChunkView]:
        """Read a whole chunk and verify that it is as saved.

        Raises
        ------
        MapDataError
            The file is damaged, unreadable (cause ``unreadable``), or was removed meanwhile (cause
            ``missing``).
        PackageMissing
            The package for its codec is not installed.
        """
        path = self.path_of(key)
        with _reading(path):
            data = read_chunk(self.files, self.chunks[key])
            view = ChunkView(decode_chunk(data, self.settings.identity(self.map_id, key, 0), path))
            return read_file_header(data), view

    def path_of(self, key: ChunkKey) -> str:
        """Return the path of a chunk's file."""
        return os.path.join(self.path, self.chunks[key])


@contextlib.contextmanager
def _reading(path: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        cause = "missing" if isinstance(error, FileNotFoundError) else "unreadable"
        raise MapDataError(f"it cannot be read: {error.strerror}", path=path, cause=cause) from error
    except MapDataError as error:
        error.hint = "`shmmap live fsck` finds all that is damaged, and quarantines it with --repair"
        raise


@contextlib.contextmanager
def opened_folder_to_read(path: str) -> Iterator[FolderToRead]:
    """Open the directory of a live map, which other processes may be changing.

    Raises
    ------
    MapMissing
        There is no live map, or it cannot be opened.
    MapDataError
        There are chunks, but no ``map.json`` that describes them.
    """
    with contextlib.closing(_opened(path)) as folder:
        yield folder


@contextlib.contextmanager
def opened_folder(path: str, hint: str) -> Iterator[Folder]:
    """Open the directory of a live map for this process alone; ``hint`` is the remedy if it is in use.

    Raises
    ------
    InstanceBusy
        Another process works with it.
    MapMissing, MapDataError
        As `opened_folder_to_read`.
    """
    _opened(path).close()  # checked first: locking would create a missing directory
    try:
        folder = Folder(path)
    except InstanceBusy as error:
        raise InstanceBusy(error.message, hint=hint) from None
    with contextlib.closing(folder):
        yield folder


def _opened(path: str) -> FolderToRead:
    try:
        folder = FolderToRead(path)
    except (FileNotFoundError, NotADirectoryError):
        raise MapMissing(f"there is no directory {path}", hint="name the directory of a live map") from None
    except OSError as error:
        raise MapMissing(
            f"cannot open {path}: {error.strerror}", hint="the user whom the daemon runs as may, and root"
        ) from error
    names = folder.names()
    if MAP_FILE in names:
        return folder
    folder.close()
    if any(name.endswith(CHUNK) for name in names):
        raise MapDataError(
            f"there are chunks, but no {MAP_FILE} that says what they are",
            path=path,
            hint="bring the file back from a copy",
        )
    raise MapMissing(f"{path} is no live map: it has no {MAP_FILE}", hint="name the directory of a live map")

# SPDX-License-Identifier: Apache-2.0
"""Read a live map from its database, without changing anything.

A daemon may be using the map meanwhile: each chunk is read in a transaction of its own, and only that long
has the daemon to keep its log.
"""

from __future__ import annotations

import contextlib
import errno
import os
import sqlite3
from collections.abc import Iterator
from typing import Final

from shmmap.chunks.chunk_file import decode_chunk
from shmmap.chunks.layout import ChunkView
from shmmap.chunks.voxels import ChunkKey
from shmmap.errors import InstanceBusy, MapDataError, MapMissing
from shmmap.live_worker.disk.folder import Folder, FolderToRead
from shmmap.live_worker.disk.map_record import MAP_FILE
from shmmap.live_worker.disk.old_directory import old_chunks, old_files
from shmmap.live_worker.disk.rebuilding import check_log
from shmmap.live_worker.disk.schema import (
    DATABASE,
    GET_DATA,
    LOG,
    check_tables,
    connect,
    database_errors,
    read_record,
    read_rows,
    require_own_files,
    valid_rows,
)

_HINTS: Final = {
    **dict.fromkeys((errno.EACCES, errno.EPERM), "the user whom the daemon runs as may, and root"),
    errno.EINVAL: "move it away, and bring the file back, if it was there",
}


class StoredMap:
    """A live map's settings, and its chunks one by one.

    Parameters
    ----------
    folder
        The map's directory.
    path
        Path of the directory in error messages.

    Attributes
    ----------
    map_id, settings
        As in the map's record.
    rows, lost
        As in `MapDatabase`.
    unknown
        As in `MapRecord`.

    Raises
    ------
    MapDataError
        The tables are damaged (cause `TABLES_DAMAGED`), or the database cannot be read.
    """

    def __init__(self, folder: FolderToRead, path: str) -> None:
        self.folder = folder
        self.path = path
        self._open()

    def _open(self) -> None:
        # without a log there is no daemon, and reading must not make one
        self._is_alone = LOG not in self.folder.names()
        with self._reading(self.path):
            require_own_files(self.folder)
            check_log(self.folder)
            mode = "ro&immutable=1" if self._is_alone else "ro"
            self._database: sqlite3.Connection = connect(self.folder, mode=mode)
            check_tables(self._database)
            record = read_record(self._database)
            self.map_id, self.settings = bytes.fromhex(record.map_id), record.settings
            self.lost, self.unknown = record.lost_chunks, record.unknown
            self.rows, self._numbers, _ = read_rows(self._database, record)

    def chunk(self, key: ChunkKey) -> ChunkView:
        """Read a whole chunk and verify that it is as saved.

        Raises
        ------
        MapDataError
            It is damaged, or cannot be read (cause ``unreadable``).
        PackageMissing
            The package for its codec is not installed.
        """
        try:
            return self._chunk(key)
        except MapDataError:
            if not self._is_alone or LOG not in self.folder.names():
                raise
        self.close()
        self._open()  # a daemon has begun meanwhile
        return self._chunk(key)

    def _chunk(self, key: ChunkKey) -> ChunkView:
        path = f"{self.path}: chunk {key.text}"
        with self._reading(path), valid_rows():
            ((data,),) = self._database.execute(GET_DATA, (self._numbers[key],)).fetchall()
            return ChunkView(decode_chunk(data, self.settings.identity(self.map_id, key, 0), path))

    @contextlib.contextmanager
    def _reading(self, path: str) -> Iterator[None]:
        """Name the path in errors, and say what to do."""
        try:
            with database_errors(self.folder):
                yield
        except OSError as error:
            raise MapDataError(
                f"it cannot be read: {error.strerror}",
                path=path,
                cause="unreadable",
                hint=_HINTS.get(error.errno or 0, "is its disk well?"),
            ) from error
        except MapDataError as error:
            raise MapDataError(
                error.message.removeprefix(f"{error.path}: "),
                path=path,
                cause=error.cause,
                hint="`shmmap live fsck` finds what is damaged; --repair makes a database of what is good",
            ) from error

    def close(self) -> None:
        """Close the database."""
        self._database.close()


@contextlib.contextmanager
def opened_folder_to_read(path: str) -> Iterator[FolderToRead]:
    """Open the directory of a live map, which other processes may be changing.

    Raises
    ------
    MapMissing
        There is no live map, or it cannot be opened.
    MapDataError
        It is one of an earlier version, or its database is missing.
    """
    with contextlib.closing(_opened(path)) as folder:
        require_database(folder)
        yield folder


@contextlib.contextmanager
def opened_map(path: str) -> Iterator[StoredMap]:
    """Open the live map in a directory to read it; raise as `opened_folder_to_read` and `StoredMap`."""
    with opened_folder_to_read(path) as folder, contextlib.closing(StoredMap(folder, path)) as stored:
        yield stored


@contextlib.contextmanager
def opened_folder(path: str, hint: str) -> Iterator[Folder]:
    """Open the directory of a live map, of any version, for this process alone.

    Parameters
    ----------
    hint
        The remedy if it is in use.

    Raises
    ------
    InstanceBusy
        Another process works with it.
    MapMissing
        There is no live map, or it cannot be opened.
    """
    _opened(path).close()  # checked first: locking would create a missing directory
    try:
        folder = Folder(path)
    except InstanceBusy as error:
        raise InstanceBusy(error.message, hint=hint) from None
    with contextlib.closing(folder):
        yield folder


def require_database(folder: FolderToRead) -> None:
    """Raise `MapDataError` for a live map without a database: of an earlier version, or a damaged one."""
    names = folder.names()
    if DATABASE in names:
        return
    if old_files(names):
        raise MapDataError(
            "it is a live map of an earlier version, with a file for each chunk",
            path=folder.path,
            hint="a daemon imports it when it starts: `shmmap serve --live NAME=DIR`",
        )
    raise MapDataError(
        f"{MAP_FILE} is there, but the database with the chunks is missing",
        path=os.path.join(folder.path, DATABASE),
        hint="bring the file back from a copy",
    )


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
    if DATABASE in names or MAP_FILE in names or old_chunks(names):
        return folder
    folder.close()
    raise MapMissing(f"{path} is no live map: it has no {DATABASE}", hint="name the directory of a live map")

# SPDX-License-Identifier: Apache-2.0
"""Begin a live map anew: all its files go aside, or for good."""

from __future__ import annotations

import os
from itertools import count

import msgspec

from shmmap.daemon.live.disk.map_record import CHUNK, MANIFEST, MAP_FILE
from shmmap.daemon.live.folder import INTERIM, Folder, FolderToRead, is_aside
from shmmap.formats.durable_file import flush_directory

__all__ = ["ResetMap", "files_of_map", "reset"]


class ResetMap(msgspec.Struct, frozen=True):
    """What was done.

    Attributes
    ----------
    path
        The directory of the map.
    moved_to
        Where the files are now; empty if they were deleted.
    files, bytes
        How many, and their size.
    """

    path: str
    moved_to: str
    files: int
    bytes: int


def files_of_map(files: FolderToRead) -> dict[str, int]:
    """The map's own files and their bytes, in the order in which they may go.

    Whatever a kill leaves is a live map still: ``map.json``, without which chunks mean nothing, goes last,
    and the manifest, for which chunks would be missing, first.
    """
    order = {MANIFEST: 0, MAP_FILE: 2}
    names = sorted(filter(_is_of_map, files.names()), key=lambda name: (order.get(name, 1), name))
    return {name: files.size(name) for name in names}


def _is_of_map(name: str) -> bool:
    if name.startswith(".") and name.endswith(INTERIM):
        return name.startswith((f".{MAP_FILE}.", f".{MANIFEST}.")) or f"{CHUNK}." in name
    return name in {MAP_FILE, MANIFEST} or name.endswith(CHUNK) or is_aside(name)


def reset(folder: Folder, *, delete: bool) -> ResetMap:
    """Move the files of a live map into a directory within its own, or delete them.

    Parameters
    ----------
    folder
        The directory, which nobody else works with.
    delete
        Instead of moving them.

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

# SPDX-License-Identifier: Apache-2.0
"""Lists the PCD files of a map and their stamps, for up to millions of files."""

from __future__ import annotations

import array
import contextlib
import os
import stat
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from shmmap.errors import MapMissing
from shmmap.origin.map_layout import is_pcd
from shmmap.origin.metadata import list_some
from shmmap.segment.process_limits import raise_limit_behind

_BLOCK_FILES = 1 << 15


@dataclass(frozen=True, slots=True)
class ScannedFiles:
    """PCD files in ascending order of their paths.

    Attributes
    ----------
    prefix
        Directory that all paths start with, ending in "/".
    names
        (N,) bytes, the rest of each path.
    stamps
        (N, 3) int64, size in bytes, mtime_ns, ctime_ns.
    directories
        Absolute path of every directory that was listed, with its status from just before.
    problems
        Files and directories that were skipped, one sentence each.
    """

    prefix: str
    names: NDArray[np.bytes_]
    stamps: NDArray[np.int64]
    directories: dict[str, os.stat_result]
    problems: tuple[str, ...]


@dataclass(slots=True)
class _Found:
    """Growing table of files; names are packed block by block, stamps as bare integers."""

    blocks: list[NDArray[np.bytes_]] = field(default_factory=list)
    names: list[bytes] = field(default_factory=list)
    stamps: array.array[int] = field(default_factory=lambda: array.array("q"))

    def add(self, name: bytes, status: os.stat_result) -> None:
        self.names.append(name)
        self.stamps.append(status.st_size)
        self.stamps.append(status.st_mtime_ns)
        self.stamps.append(status.st_ctime_ns)
        if len(self.names) == _BLOCK_FILES:
            self.pack()

    def pack(self) -> None:
        self.blocks.append(np.array(self.names, dtype=np.bytes_))
        self.names = []


def scan(root: str, *, recursive: bool, at: Callable[[str], str] = str) -> ScannedFiles:
    """List the PCD files in ``root``, the absolute path of a directory or of a single file.

    ``at`` turns a path into the one under which this process can open it.

    A file that is reached twice counts once; a directory that is reached twice is listed once.  Symbolic
    links are followed and keep their own names.  Names that are not UTF-8 are left out; so are hidden
    directories when recursing.

    Raises
    ------
    MapMissing
        The root cannot be read.
    LimitReached
        A limit of this process or the machine does not let it read a directory, which may have cells.
    """
    prefix = os.path.join(root if os.path.isdir(at(root)) else os.path.dirname(root), "")
    skip = len(os.fsencode(prefix))
    found = _Found()
    problems: dict[str, list[str]] = {}
    directories: dict[str, os.stat_result] = {}
    seen: set[tuple[int, int]] = set()
    pending: list[tuple[bytes, bytes]] = []  # path to open a directory by, and its path in the map
    root_place, path = os.fsencode(at(root)), os.fsencode(root)
    try:
        status = os.stat(root_place)
        if stat.S_ISDIR(status.st_mode):
            os.scandir(root_place).close()
            pending.append((root_place, path))
        else:
            found.add(path[skip:], status)
    except OSError as error:
        raise_limit_behind(error)
        raise MapMissing(f"cannot read {root}: {error.strerror}") from error
    while pending:
        place, directory = pending.pop()
        try:
            status = os.stat(place)
            if (status.st_dev, status.st_ino) in seen:
                continue
            seen.add((status.st_dev, status.st_ino))
            inner = _list_directory(place, directory, skip, found, problems)
        except OSError as error:
            raise_limit_behind(error)
            problems.setdefault(f"cannot be listed ({error.strerror})", []).append(_readable(directory))
            continue
        directories[os.fsdecode(directory)] = status
        if recursive:
            pending += [(os.path.join(place, name), os.path.join(directory, name)) for name in inner]
    found.pack()
    names = np.concatenate(found.blocks)
    found.blocks.clear()
    names, first = np.unique(names, return_index=True)
    stamps = np.frombuffer(found.stamps, dtype=np.int64).reshape(-1, 3)[first]
    reports = tuple(f"{what}: {list_some(sorted(paths))}" for what, paths in problems.items())
    return ScannedFiles(prefix, names, stamps, directories, reports)


def _list_directory(
    place: bytes, directory: bytes, skip: int, found: _Found, problems: dict[str, list[str]]
) -> list[bytes]:
    """Add a directory's PCD files to ``found``; return the names of the directories in it."""
    inner: list[bytes] = []
    below = os.path.join(directory, b"")[skip:]
    with _opened(place) as fd, os.scandir(fd) as entries:  # stat by name is quicker than by path
        for entry in entries:
            name = os.fsencode(entry.name)
            try:
                is_directory = entry.is_dir()
                if name.startswith(b".") if is_directory else not is_pcd(name):
                    continue
                status = entry.stat()
            except OSError as error:  # e.g. a link to itself, or to a path this user may not read
                problem = f"cannot be read ({error.strerror})"
            else:
                if not _is_utf8(name):
                    problem = "the name is not UTF-8"
                elif is_directory:
                    inner.append(name)
                    continue
                elif stat.S_ISREG(status.st_mode):
                    found.add(below + name, status)
                    continue
                else:
                    problem = "no regular file"
            problems.setdefault(problem, []).append(_readable(os.path.join(directory, name)))
    return inner


@contextlib.contextmanager
def _opened(place: bytes) -> Iterator[int]:
    fd = os.open(place, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield fd
    finally:
        os.close(fd)


def _is_utf8(name: bytes) -> bool:
    """Whether a file name is UTF-8, so that clients can name the file."""
    try:
        name.decode()
    except UnicodeDecodeError:
        return False
    return True


def _readable(path: bytes) -> str:
    return path.decode("utf-8", "backslashreplace")

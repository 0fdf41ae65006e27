# SPDX-License-Identifier: Apache-2.0
"""Finds a map's PCD files and metadata in every layout in use, and holds its directories open.

========================================================  =============================================
``map/pointcloud_map.pcd/*.pcd``, YAML beside the folder  Autoware's; the divider writes it
the same with the YAML inside the folder                  older maps
a folder of PCD files, YAML inside or beside it           the inner folder given directly
``.../pointcloud_map.pcd/<gx>_<gy>/*.pcd``                the divider's large grid (not when strict)
``map/pointcloud_map.pcd`` (a file), or any one PCD       a map that was never divided
========================================================  =============================================

Paths become absolute as `os.path.abspath` does it: relative spellings, ``.``, ``..`` and doubled
slashes vanish.  Symbolic links stay as given, as in Autoware: a link such as ``maps/current`` can be
switched to another map, and a reload then finds the cells changed rather than renamed.

A link such as ``maps/current``, or ``..data`` inside a Kubernetes volume, may be switched to another map at
any moment.  So each directory of a state of the map is opened once, when it is found, and all files of that
state are read through these descriptors: no link on the path can mix two maps.  A later state
(`MapDirectory.load`) opens the directories again.
"""

from __future__ import annotations

import contextlib
import filecmp
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

from shmmap.errors import MapDataError, MapMissing
from shmmap.segment.process_limits import raise_limit_behind

KUBERNETES_LINK: Final = "..data"
"""In a Kubernetes volume, every visible name is a link through this link, which is switched atomically."""


class OpenedDirectories:
    """Opens directories, and translates paths into and below them.

    Parameters
    ----------
    inherited
        Descriptors by path, inherited from the process that opened them.
    """

    def __init__(self, inherited: Mapping[str, int] | None = None) -> None:
        self.descriptors: dict[str, int] = dict(inherited or {})

    def __del__(self) -> None:
        for fd in self.descriptors.values():
            with contextlib.suppress(OSError):
                os.close(fd)

    def open(self, path: str) -> None:
        """Open a directory, relative to an open parent if there is one; skip a path that is no directory.

        Raises
        ------
        LimitReached
            This process or the machine has as many files open as it may.
        """
        if path in self.descriptors:
            return
        flags = os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC
        try:
            fd = os.open(self.at(path), flags)
        except OSError as error:  # other errors are reported when the directory is read
            raise_limit_behind(error)
            return
        self.descriptors[path] = fd
        if _is_volume(fd):
            self.descriptors[path] = os.open(KUBERNETES_LINK, flags, dir_fd=fd)
            os.close(fd)

    def at(self, path: str) -> str:
        """Return the path by which this process can open ``path``: below the innermost open directory."""
        above, fd = self.innermost(path)
        return f"/proc/self/fd/{fd}{path[len(above.rstrip('/')) :]}" if fd >= 0 else path

    def innermost(self, path: str) -> tuple[str, int]:
        """Return path and descriptor of the innermost open directory that contains ``path``; -1: none."""
        above = path
        while above not in self.descriptors:
            if above in ("", "/"):
                return "", -1
            above = os.path.dirname(above)
        return above, self.descriptors[above]

    def named(self, text: str) -> str:
        """Return a message with descriptor paths replaced by the original paths."""
        for path, fd in self.descriptors.items():
            text = text.replace(f"/proc/self/fd/{fd}/", path.rstrip("/") + "/")
        return text


def _is_volume(fd: int) -> bool:
    """Whether all visible entries of a directory are links through `KUBERNETES_LINK`."""
    place = f"/proc/self/fd/{fd}"
    if not (os.path.islink(f"{place}/{KUBERNETES_LINK}") and os.path.isdir(f"{place}/{KUBERNETES_LINK}")):
        return False
    try:
        with os.scandir(place) as entries:
            visible = [entry.path for entry in entries if not entry.name.startswith("..")]
        return all(os.readlink(path).startswith(KUBERNETES_LINK + "/") for path in visible)
    except OSError as error:
        raise_limit_behind(error)
        return False


_CELLS_NAME = "pointcloud_map.pcd"
# the second name is that in the README of Autoware's divider
_METADATA_NAMES = ("pointcloud_map_metadata.yaml", "pointcloud_data_metadata.yaml")


@dataclass(frozen=True, slots=True)
class MapLayout:
    """Paths of the parts of a map.

    Attributes
    ----------
    root
        Absolute path of the directory that holds the cells, or of the one file.
    metadata
        Absolute path of the metadata file; None if the map has none.
    """

    root: str
    metadata: str | None


def is_pcd(name: bytes) -> bool:
    """Whether a file name ends in .pcd, in upper or lower case."""
    return name[-4:].lower() == b".pcd"


def absolute_path(path: str | os.PathLike[str]) -> str:
    """Return ``path`` absolute and normalised; symbolic links are kept.

    Raises
    ------
    MapDataError
        The path is not UTF-8, so no client could name the cells.
    """
    text = os.path.abspath(os.fspath(path))
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise MapDataError("the path is not UTF-8", path=ascii(text), cause="bad_path") from error
    # "link/.." is the parent of the link's target, not of the link
    misled = os.path.exists(path) and not (os.path.exists(text) and os.path.samefile(path, text))
    return os.path.realpath(path) if misled else text


def find_layout(path: str, metadata: str | None, opened: OpenedDirectories | None = None) -> MapLayout:
    """Find the parts of the map at ``path``; all paths are absolute.

    Parameters
    ----------
    path
        A map directory, a directory of cells, one PCD file, or a metadata file.
    metadata
        The metadata file, if it is elsewhere.
    opened
        Opens the map's directories; all files are accessed through its descriptors.

    Raises
    ------
    MapMissing
        Nothing exists at ``path``, or it is not a map.
    LimitReached
        This process or the machine has as many files open as it may.
    """
    opened = opened or OpenedDirectories()
    opened.open(os.path.dirname(path))
    opened.open(path)
    if metadata is not None:
        opened.open(os.path.dirname(metadata))
    try:
        os.stat(opened.at(path))
    except OSError as error:
        raise MapMissing(
            f"there is no map at {path}: {str(error.strerror).lower()}",
            hint="name the directory of a divided map, or one cloud; `shmmap demo` needs no map",
        ) from error
    if metadata is not None and not os.path.isfile(opened.at(metadata)):
        raise MapMissing(
            f"there is no metadata file at {metadata}", hint="name the YAML file that lists the map's cells"
        )
    if os.path.isfile(opened.at(path)) and path.lower().endswith((".yaml", ".yml")):
        metadata = metadata or path
        path = os.path.dirname(path)
    cells = os.path.join(path, _CELLS_NAME)
    opened.open(cells)
    root = cells if os.path.exists(opened.at(cells)) else path
    if metadata is None and os.path.isdir(opened.at(path)):
        metadata = _find_metadata(path, root, opened)
    return MapLayout(root, metadata)


def other_metadata(root: str, metadata: str, opened: OpenedDirectories) -> list[str]:
    """Return files beside and among the cells that could be the map's metadata, too, and differ from it."""
    candidates = (
        os.path.join(folder, name) for folder in (os.path.dirname(root), root) for name in _METADATA_NAMES
    )
    return [
        path
        for path in candidates
        if os.path.isfile(opened.at(path))
        and not filecmp.cmp(opened.at(path), opened.at(metadata), shallow=False)
    ]


def _find_metadata(path: str, root: str, opened: OpenedDirectories) -> str | None:
    folders = [path, root]
    if os.path.basename(path) == _CELLS_NAME or _holds_pcd(opened.at(path)):
        folders.append(os.path.dirname(path))
    for folder in folders:
        for name in _METADATA_NAMES:
            candidate = os.path.join(folder, name)
            if os.path.isfile(opened.at(candidate)):
                return candidate
    return None


def _holds_pcd(directory: str) -> bool:
    try:
        with os.scandir(directory) as entries:
            return any(is_pcd(os.fsencode(entry.name)) and entry.is_file() for entry in entries)
    except OSError as error:
        raise_limit_behind(error)
        return False


def divided_beside(path: str) -> list[str]:
    """Return the folders beside a file that hold PCD files: a map may be there both whole and in cells."""
    folder = os.path.dirname(path)
    return [other for name in _listed(folder) if _holds_pcd(other := os.path.join(folder, name))]


def yaml_files(folders: Iterable[str], opened: OpenedDirectories) -> list[str]:
    """Return the YAML files in folders that may be metadata under a name of their own."""
    return [
        os.path.join(folder, name)
        for folder in folders
        for name in _listed(opened.at(folder))
        if name.lower().endswith((".yaml", ".yml"))
    ]


def _listed(directory: str) -> list[str]:
    try:
        return sorted(os.listdir(directory))
    except OSError as error:
        raise_limit_behind(error)
        return []

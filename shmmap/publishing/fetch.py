# SPDX-License-Identifier: Apache-2.0
"""Fetches a published map into files: a divided map in Autoware's format, with every object verified.

The directory appears complete or not at all.  A run after an interrupted one does not fetch its cells again:
each finished file's hash (XXH3) is noted, and a file that does not match it is fetched again.
"""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import secrets
from collections.abc import Iterable
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from xxhash import xxh3_128_hexdigest

from shmmap.dividing.inputs import check_output_directory
from shmmap.dividing.settings import memory_left
from shmmap.dividing.workspace import Workspace
from shmmap.errors import BadRequest, MapDataError, MapMissing
from shmmap.failpoints import step
from shmmap.formats.durable_file import writing_errors
from shmmap.formats.pcd.writer import write_pcd
from shmmap.origin.map_report import REPORT_HEAD, REPORT_NAME, MapFrame
from shmmap.origin.metadata import METADATA_NAME, metadata_text
from shmmap.origin.remote.map_versions import Current, read_entry, read_root, read_shards, require_current
from shmmap.origin.remote.object_tier import KeptObjects, ObjectTier
from shmmap.origin.remote.published_index import Root
from shmmap.origin.remote.published_object import POINTS, ObjectName, read_bare_header, rows_of
from shmmap.origin.remote.store import Store
from shmmap.origin.remote.zstd_frame import DAMAGED, unpack_frame
from shmmap.private_directory import open_own
from shmmap.processes.request_threads import RequestThreads
from shmmap.progress import Progress
from shmmap.work_room import WorkRoom

_CELLS: Final = "pointcloud_map.pcd"
_NEW: Final = "new"  # directory of the files in writing: no cell's name can be that of one of them
_FETCHED: Final = "fetched"
_CONCURRENT_FETCHES: Final = 16
_MEMORY_BYTES: Final = 1 << 30
_COPIES: Final = 3  # an object, its columns, twice as large where they are in millimetres
_MAX_DIRECTORIES: Final = 32
_MAX_NAME_BYTES: Final = 255
_MAX_PATH_BYTES: Final = 3000  # PATH_MAX less what may come before it
_SAME_M: Final = 1e-6


@dataclass(frozen=True, slots=True)
class FetchedMap:
    """Result of fetching a map.

    Attributes
    ----------
    path
        The map's directory.
    version, map_version
        Version number and map version of the published map.
    fetched_cells
        Number of cells fetched, without those of an interrupted earlier run.
    fetched_bytes
        Bytes of the fetched cells' objects that were read from the store.
    """

    path: str
    version: int
    map_version: int
    cells: int
    points: int
    fetched_cells: int
    fetched_bytes: int


def fetch_map(
    store: Store,
    out: str,
    *,
    version: int | None = None,
    current: Current | None = None,
    force: bool = False,
    tier: ObjectTier | None = None,
    progress: Progress,
) -> FetchedMap:
    """Write a version of a published map as a divided map.

    Parameters
    ----------
    out
        The directory to create; it must be missing or empty, or a divided map that ``force`` replaces.
    version
        Version to fetch; None: the current one.
    current
        The current version, if it was verified; None: the one in ``CURRENT``.
    tier
        Disk cache whose objects need not be fetched; fetched objects are not added to it.

    Raises
    ------
    BadRequest
        ``out`` exists, or the map cannot be written in that format.
    MapMissing, MapDataError, Offline
        The version does not exist, an object is missing or damaged, or the store does not answer.
    CannotWrite
        The disk is full or not writable.
    InstanceBusy
        Another run is writing ``out``.
    """
    out = os.path.abspath(out)
    check_output_directory(out, force=force)
    if version is None:
        current = current or require_current(store)
    else:
        try:
            current = read_entry(store, version).current
        except MapMissing:
            raise MapMissing(f"there is no version {version} at {store.url}") from None
    pages = KeptObjects(store, tier, is_index=True, keep=False)
    objects = KeptObjects(store, tier, keep=False)
    root = read_root(pages, current)
    with writing_errors(out), Workspace(out, "fetching", keep_failed=True) as workspace:
        begun = {"root": current.root}
        found = workspace.state()
        if found is None or found.get("root") != current.root:
            workspace.empty()
            workspace.save(begun)
        fetched = _Fetch(pages, objects, root, workspace).run(progress)
        step("fetch.whole")
        check_output_directory(out, force=force)  # it may have come meanwhile
        workspace.publish(replace=force, durable=True)
        step("fetch.renamed")
    progress.done(root.cells)
    return FetchedMap(
        out, current.version, root.map_version, root.cells, fetched.points, fetched.cells, fetched.bytes
    )


@dataclass(slots=True)
class _Counts:
    points: int = 0
    cells: int = 0
    bytes: int = 0


class _Fetch:
    """Fetches the cells of a root into a directory."""

    def __init__(self, pages: KeptObjects, objects: KeptObjects, root: Root, workspace: Workspace) -> None:
        self._pages = pages
        self._objects = objects
        self._root = root
        self._workspace = workspace
        self._directory = workspace.directory("map")
        self._cells_dir = workspace.directory(f"map/{_CELLS}")
        self._new = workspace.directory(_NEW)
        self._room = WorkRoom(memory_left(_MEMORY_BYTES))

    def run(self, progress: Progress) -> _Counts:
        counts = _Counts()
        boxes: list[NDArray[np.float64]] = []
        names: dict[str, None] = {}
        progress.stage("fetch", self._root.cells)
        with (
            _Finished(os.path.join(self._workspace.path, _FETCHED)) as self._finished,
            RequestThreads(_CONCURRENT_FETCHES, "fetch") as pool,
        ):
            self._clear()
            for shard in read_shards(self._pages, self._root):
                boxes.append(shard.boxes)
                here = [name.decode() for name in shard.names]
                for name in here:
                    self._check_name(name, names)
                names.update(dict.fromkeys(here))
                counts.points += int(shard.points.sum(dtype=np.uint64))
                objects = map(shard.layers[POINTS].name, range(len(shard)))
                for is_new in pool.map(self._fetch, here, objects):
                    counts.cells += is_new
                    progress.advance(1)
        counts.bytes = self._objects.counts.fetched_bytes
        self._write_metadata(names, np.concatenate(boxes))
        self._write_report()
        return counts

    def _clear(self) -> None:
        """Remove all but files that an interrupted run has finished, links too; their hashes come later."""
        self._workspace.clear(_NEW)
        self._workspace.clear("map", but=(_CELLS,))
        for directory, _, _ in os.walk(self._cells_dir):
            below = os.path.relpath(directory, self._cells_dir)
            with os.scandir(directory) as entries:
                kept = [
                    entry.name
                    for entry in entries
                    if entry.is_dir(follow_symlinks=False)
                    != (os.path.normpath(os.path.join(below, entry.name)) in self._finished)
                ]
            self._workspace.clear(directory, but=kept)

    def _check_name(self, name: str, before: dict[str, None]) -> None:
        """Refuse a cell whose name cannot be that of a file, or that an earlier shard has."""
        parts = os.fsencode(name).split(b"/")
        shown = name if len(name) <= _MAX_NAME_BYTES else f"{name[:64]} ... ({len(name)} characters)"
        if name in before:
            raise MapDataError(f"it has two cells {shown}", path=self._objects.url, cause=DAMAGED)
        if (
            len(parts) > _MAX_DIRECTORIES
            or max(map(len, parts)) > _MAX_NAME_BYTES
            or len(name.encode()) > _MAX_PATH_BYTES
        ):
            raise BadRequest(
                f"the cell {shown} cannot be a file: its name is too long, or in too many folders"
            )

    def _fetch(self, name: str, source: ObjectName) -> bool:
        """Write a cell's file; return False if it exists already."""
        path = os.path.join(self._cells_dir, name)
        if self._finished.is_whole(name, path):
            return False
        with self._room.taken(source.size + _COPIES * source.raw):
            frame = self._objects.read(source.sha256, source.size)
            unpacked = unpack_frame(frame, source.raw, name=source.path, exact=True)
            header = read_bare_header(unpacked, POINTS, name=f"{self._objects.url}/{source.path}")
            if any(header.origin):
                raise MapDataError("its coordinates have an origin of their own", path=source.path)
            columns: dict[str, NDArray[Any]] = {
                column.name: rows_of(unpacked, column) for column in header.columns
            }
            folder = os.path.dirname(name)
            self._workspace.directory(f"map/{_CELLS}" + (f"/{folder}" if folder else ""))
            interim = os.path.join(self._new, secrets.token_hex(8))
            with open(interim, "xb") as file:
                write_pcd(file, columns)
        digest = _digest_of(interim)
        step("fetch.cell")
        os.rename(interim, path)
        self._finished.add(name, digest)
        return True

    def _write_metadata(self, names: Iterable[str], boxes: NDArray[np.float64]) -> None:
        size_x, size_y = (_only_size(boxes[:, axis], boxes[:, axis + 2]) for axis in (0, 1))
        entries = [
            (os.path.basename(name), (_number_text(x), _number_text(y)))
            for name, (x, y) in zip(names, boxes[:, :2].tolist(), strict=True)
        ]
        corners = dict(entries)
        if any(corners[name] != corner for name, corner in entries):
            raise BadRequest(
                "two cells have one file name and different places: a divided map cannot express that"
            )
        text = metadata_text(_number_text(size_x), corners.items(), _number_text(size_y))
        with open(os.path.join(self._directory, METADATA_NAME), "w", encoding="utf-8") as file:
            file.write(text)

    def _write_report(self) -> None:
        frame = MapFrame(self._root.origin, self._root.crs, self._root.unit_m)
        report = {**REPORT_HEAD, "origin": frame.origin, "crs": frame.crs, "unit_m": frame.unit_m}
        with open(os.path.join(self._directory, REPORT_NAME), "w", encoding="utf-8") as file:
            json.dump(report, file, indent=2)


class _Finished:
    """The names of finished files with their hashes: a line for each, of which the last may be cut."""

    def __init__(self, path: str) -> None:
        fd = open_own(path, os.O_RDWR | os.O_CREAT | os.O_APPEND)
        self._file = open(fd, "r+b", buffering=0)  # noqa: SIM115  closed by __exit__
        self._digests: dict[str, str] = {}
        for line in self._file.readall().split(b"\n"):
            with contextlib.suppress(ValueError):
                name, digest = json.loads(line)
                self._digests[str(name)] = str(digest)

    def __enter__(self) -> _Finished:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def __contains__(self, name: str) -> bool:
        return name in self._digests

    def is_whole(self, name: str, path: str) -> bool:
        """Whether a file has the content with which it was finished."""
        if name not in self:
            return False
        try:
            return _digest_of(path) == self._digests[name]
        except OSError:
            return False

    def add(self, name: str, digest: str) -> None:
        """Note a finished file."""
        self._file.write(b"\n" + json.dumps([name, digest]).encode() + b"\n")  # at once, whatever others add


def _digest_of(path: str) -> str:
    """Return the hash of a file that this user has made; OSError for anything else."""
    fd = open_own(path, os.O_RDONLY)
    try:
        size = os.fstat(fd).st_size
        if not size:
            raise OSError(f"{path} is empty")
        with mmap.mmap(fd, size, prot=mmap.PROT_READ) as content:
            return xxh3_128_hexdigest(content)
    finally:
        os.close(fd)


def _only_size(low: NDArray[np.float64], high: NDArray[np.float64]) -> float:
    """Return the common size of all cells along an axis, such that corner plus size gives the box again."""
    sizes = high - low
    for size in (round(float(sizes[0]), 9), float(sizes[0])):
        if (low + size == high).all():
            return size
    if np.ptp(sizes) > _SAME_M:
        raise BadRequest("its cells are of different sizes: a divided map cannot express that")
    return float(np.median(sizes))


def _number_text(value: float) -> str:
    """Return the shortest text that gives the same float; whole numbers as integers."""
    return str(int(value)) if value.is_integer() else repr(value)

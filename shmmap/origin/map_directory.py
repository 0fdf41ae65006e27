# SPDX-License-Identifier: Apache-2.0
"""Opens a map on disk: Autoware's divided format in all its layouts, or a single PCD file."""

from __future__ import annotations

import dataclasses
import json
import os
import time
import unicodedata
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shmmap.errors import MapDataError, MapMissing
from shmmap.formats.cloud import cloud_suffix
from shmmap.formats.coordinate_system import degrees_warning, unit_warnings
from shmmap.formats.pcd.reader import PcdReader
from shmmap.formats.point_checks import step_warning
from shmmap.origin.catalogue import Catalogue
from shmmap.origin.catalogue_bytes import (
    Source,
    default_cache_directory,
    load_sidecar,
    save_sidecar,
    sidecar_file,
)
from shmmap.origin.cell_names import base_names
from shmmap.origin.directory_scan import ScannedFiles, scan
from shmmap.origin.map_layout import (
    MapLayout,
    OpenedDirectories,
    absolute_path,
    divided_beside,
    find_layout,
    other_metadata,
    yaml_files,
)
from shmmap.origin.map_report import read_map_frame
from shmmap.origin.metadata import (
    MAX_METADATA_BYTES,
    TOO_LARGE,
    MapMetadata,
    list_some,
    metadata_bytes,
    parse_metadata,
)
from shmmap.origin.reading_apart import read_apart
from shmmap.segment.layout import SourceStamp

# Smaller maps are scanned in a few milliseconds, so a cached catalogue would only be older, not quicker.
_CACHED_FROM_CELLS = 2000

# Longer metadata, from about 2000 cells, is read in a separate process: a parser holds the interpreter lock
# while it parses one number or name, and all threads here would wait.
_READ_HERE_BYTES = 64 << 10


def open_map(
    path: str | os.PathLike[str],
    *,
    metadata: str | os.PathLike[str] | None = None,
    strict: bool = False,
    cache_dir: str | os.PathLike[str] | None = None,
) -> MapDirectory:
    """Find the map at ``path``; `MapDirectory.load` then reads its catalogue.

    Parameters
    ----------
    path
        A map directory, a directory of cells, one PCD file, or a metadata file.
    metadata
        The metadata file, if it is not beside or among the cells.
    strict
        Behave like Autoware's loader: integer corners only, no unknown keys, an entry without its
        file is an error, directories are not searched recursively.
    cache_dir
        Directory that caches the catalogues of large maps; default `default_cache_directory()`.

    Raises
    ------
    MapMissing
        There is no map at ``path``.
    """
    found = MapDirectory(
        path=absolute_path(path),
        metadata=None if metadata is None else absolute_path(metadata),
        strict=strict,
        cache_dir=default_cache_directory() if cache_dir is None else os.path.abspath(cache_dir),
    )
    find_layout(found.path, found.metadata)
    return found


@dataclass(frozen=True, slots=True)
class MapDirectory:
    """A map on disk; all paths are absolute.  See `open_map` for the fields.

    ``cached_from_cells`` is the number of cells from which a catalogue is worth caching.
    """

    path: str
    metadata: str | None = None
    strict: bool = False
    cache_dir: str = ""
    cached_from_cells: int = _CACHED_FROM_CELLS

    def load(self, *, fresh: bool = False, before: object | None = None) -> Catalogue:
        """Read the map's present cells, with their boxes and their files' stamps.

        A large map's catalogue comes from the cache while the metadata and the directories are
        unchanged; stamps may then be older than the files.  ``fresh`` reads the stamp of every file.  Long
        metadata is read in a separate process (`shmmap.origin.reading_apart`).  The result shares unchanged
        tables with ``before``, an earlier state.

        Raises
        ------
        MapMissing
            There is no map, or no PCD file in it.
        MapDataError
            The metadata is wrong, fits none of the files, or (strict) lacks some of them.
        """
        opened = OpenedDirectories()
        layout = find_layout(self.path, self.metadata, opened)
        catalogue = self._catalogue(self._key(layout), fresh, before, opened)
        catalogue.opened = opened
        if layout.metadata is not None:
            catalogue.frame = read_map_frame(opened.at(os.path.dirname(layout.metadata)))
        return catalogue

    def _catalogue(
        self, key: str, fresh: bool, before: object | None, opened: OpenedDirectories
    ) -> Catalogue:
        sidecar = sidecar_file(self.cache_dir, key)
        if not fresh and (cached := load_sidecar(sidecar, key, opened.at)) is not None:
            return cached
        try:
            return self.scanned(_READ_HERE_BYTES, opened)
        except MapDataError as error:
            if error.cause != TOO_LARGE:
                raise
        earlier = before if isinstance(before, Catalogue) else None
        words = json.dumps([dataclasses.asdict(self), opened.descriptors])
        return read_apart(self.path, words, earlier, tuple(opened.descriptors.values()))

    def _key(self, layout: MapLayout) -> str:
        return json.dumps([layout.root, layout.metadata, self.strict])

    def scanned(
        self, max_bytes: int = MAX_METADATA_BYTES, opened: OpenedDirectories | None = None
    ) -> Catalogue:
        """Read the catalogue from metadata and files, and cache it if it is large; see `load`.

        Metadata of more than ``max_bytes`` is refused before any file is scanned.
        """
        opened = opened or OpenedDirectories()
        layout = find_layout(self.path, self.metadata, opened)
        key = self._key(layout)
        sidecar = sidecar_file(self.cache_dir, key)
        scanned_ns = time.time_ns()
        data, sources = b"", []
        if layout.metadata is not None:
            # status taken before reading: a change in between then differs from the recorded status
            sources = [Source.of(layout.metadata, _status(layout.metadata, opened))]
            data = metadata_bytes(layout.metadata, max_bytes, at=opened.at(layout.metadata))
        files = scan(layout.root, recursive=not self.strict, at=opened.at)
        if not len(files.names):
            unusable = f" that can be read: {'; '.join(files.problems)}" if files.problems else ""
            raise MapMissing(
                f"there is no PCD file in {layout.root}{unusable}",
                hint="a divided map is a directory of PCD files; `shmmap divide` makes one of other clouds",
            )
        if layout.metadata is None:
            catalogue = _without_metadata(files, layout.root, opened)
            if layout.root != self.path and (hint := _divided_hint(layout.root)):
                catalogue.problems += (f"{layout.root} is served, the map in one piece; {hint}",)
            return catalogue
        entries = parse_metadata(data, path=layout.metadata, strict=self.strict)
        del data  # with ten million cells it is the largest table of all
        catalogue = _joined(layout, layout.metadata, files, entries, strict=self.strict)
        if self.metadata is None and (others := other_metadata(layout.root, layout.metadata, opened)):
            catalogue.problems += (f"{layout.metadata} is read, not {' or '.join(others)}",)
        if len(catalogue) >= self.cached_from_cells and os.path.isdir(opened.at(layout.root)):
            sources += [Source.of(path, status) for path, status in files.directories.items()]
            save_sidecar(sidecar, key, sources, catalogue, scanned_ns)
        return catalogue


def _status(path: str, opened: OpenedDirectories) -> os.stat_result:
    try:
        return os.stat(opened.at(path))
    except OSError as error:
        raise MapMissing(f"cannot read {path}: {error.strerror}") from error


def _without_metadata(files: ScannedFiles, root: str, opened: OpenedDirectories) -> Catalogue:
    if len(files.names) > 1:
        lists = yaml_files([root, os.path.dirname(root)], opened)
        named = f" (is it {' or '.join(lists[:3])}?)" if lists else ""
        raise MapDataError(
            f"{len(files.names)} PCD files but no pointcloud_map_metadata.yaml, in or beside it",
            path=files.prefix,
            cause="no_metadata",
            hint=f"name the metadata file with --metadata FILE{named}, or one of the PCD files to serve it"
            " alone",
        )
    return load_single_pcd(files.prefix + os.fsdecode(bytes(files.names[0])))


def _joined(
    layout: MapLayout, metadata: str, files: ScannedFiles, entries: MapMetadata, *, strict: bool
) -> Catalogue:
    """Match entries with files by base name, as Autoware does."""
    if not len(entries.names):
        raise MapDataError("it lists no cells", path=metadata, cause="no_cells")
    bases = base_names(files.names)
    entry, has_entry, lacks_file = _matched(entries.names, bases)
    if lacks_file.any() and not has_entry.all():  # macOS and some archives decompose accents
        entry, has_entry, lacks_file = _matched(_composed(entries.names), _composed(bases))
    problems = [*files.problems, *(f"{metadata}: {text}" for text in entries.problems)]
    if lacks_file.any():
        listed = list_some([os.fsdecode(name) for name in entries.names[lacks_file].tolist()])
        if strict or len(entry) == 0:
            raise MapDataError(
                f"these entries have no file in {layout.root}: {listed}",
                path=metadata,
                cause="missing_files",
                hint=_divided_hint(layout.root),
            )
        problems.append(f"{metadata}: entries whose file is missing, not served: {listed}")
    names, stamps = files.names, files.stamps
    if not has_entry.all():
        names, stamps = names[has_entry], stamps[has_entry]
        listed = list_some([os.fsdecode(name) for name in files.names[~has_entry].tolist()])
        problems.append(f"{metadata}: files without an entry, not served: {listed}")
    if len(names) > len(entries.names) - int(lacks_file.sum()):
        problems.append("some base names stand for several files, all served with the same box")
    problems += _unit_problems(files.prefix + os.fsdecode(bytes(names[0])))
    sides = np.empty((4, len(entry)))
    sides[:2] = entries.corners[entry].T
    sides[2:] = sides[:2] + np.array([[entries.x_resolution], [entries.y_resolution]])
    return Catalogue(
        id_prefix=files.prefix,
        # as narrow as the longest name, because the catalogue's version covers the padded table
        names=names.astype(f"S{int(np.char.str_len(names).max())}", copy=False),
        boxes=sides.T,
        stamps=stamps,
        problems=problems,
    )


def _unit_problems(path: str) -> list[str]:
    """Return what one cell's header says about units; the cells of a map are written by one program."""
    try:
        with PcdReader(path) as reader:
            return [f"{path}: {warning}" for warning in unit_warnings(reader.header.crs)]
    except (OSError, MapDataError):
        return []  # loading it reports what is wrong


def _matched(
    entries: NDArray[np.bytes_], bases: NDArray[np.bytes_]
) -> tuple[NDArray[np.intp], NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the entry of each file that has one, which files have one, and which entries have no file."""
    order = np.argsort(entries, kind="stable")
    ascending = entries[order]
    at = np.minimum(ascending.searchsorted(bases), len(ascending) - 1)
    has_entry = ascending[at] == bases
    entry = order[at[has_entry]]
    lacks_file = np.ones(len(entries), dtype=np.bool_)
    lacks_file[entry] = False
    return entry, has_entry, lacks_file


def _composed(names: NDArray[np.bytes_]) -> NDArray[np.bytes_]:
    """Return names with accents composed (Unicode's form NFC)."""
    texts = (os.fsdecode(name) for name in names.tolist())
    return np.array([os.fsencode(unicodedata.normalize("NFC", text)) for text in texts], np.bytes_)


def _divided_hint(path: str) -> str:
    """Return a hint to the folder beside one file that holds the map in cells; empty if there is none."""
    if not os.path.isfile(path):
        return ""
    folders = divided_beside(path)
    return f"the map in cells seems to be {' or '.join(folders[:3])}: name that" if folders else ""


MAX_SINGLE_PCD_BYTES = 256 << 20
"""Size limit of a map that is one PCD file; a larger one has to be divided."""

# Size limit of its points once decompressed; point clouds shrink to a half or a third.
_MAX_POINT_BYTES = 4 * MAX_SINGLE_PCD_BYTES


def is_served_whole(path: str) -> bool:
    """Whether the PCD file at ``path`` can be one cell: small, in metres; True for a damaged file, too."""
    try:
        if os.stat(path).st_size > MAX_SINGLE_PCD_BYTES:
            return False
        with PcdReader(path) as reader:
            header = reader.header
            return not unit_warnings(header.crs) and header.points * header.point_bytes <= _MAX_POINT_BYTES
    except (OSError, MapDataError):
        return True  # loading it reports what is wrong


def load_single_pcd(path: str) -> Catalogue:
    """Return a catalogue of one cell, its box the bounds of the points in ``path`` (read whole).

    Raises
    ------
    MapMissing
        The file vanished or may not be read.
    MapDataError
        The file is larger than 256 MiB (or its points than 1 GiB), is not a valid PCD file, or has no
        finite point.
    """
    try:
        status = os.stat(path)
    except OSError as error:
        raise MapMissing(f"cannot read {path}: {error.strerror}") from error
    _refuse_large(path, "file", status.st_size, MAX_SINGLE_PCD_BYTES)
    with _opened_pcd(path) as reader:
        points_bytes = reader.header.points * reader.header.point_bytes
        _refuse_large(path, "points", points_bytes, _MAX_POINT_BYTES)
        for _ in reader.blocks():
            pass
        lower, upper = reader.bounds
    if not np.isfinite(lower).all():
        raise MapDataError("no finite point, so the map has no extent", path=path, cause="no_points")
    box = (float(lower[0]), float(lower[1]), float(upper[0]), float(upper[1]))
    units = unit_warnings(reader.header.crs)
    warnings = (*units, degrees_warning(lower, upper), step_warning(lower, upper, reader.columns[0].dtype))
    problems = [f"{path}: {warning}" for warning in warnings if warning]
    return Catalogue.from_cells([(path, box, SourceStamp.of(status))], problems=problems)


def _opened_pcd(path: str) -> PcdReader:
    """Open a PCD file; the error for another file type names the readable types."""
    try:
        return PcdReader(path)
    except MapDataError as error:
        if error.cause == "not_pcd":
            cloud_suffix(path)
        raise


def _refuse_large(path: str, what: str, size: int, limit: int) -> None:
    if size > limit:
        raise MapDataError(
            f"{size / 2**20:.0f} MiB of {what}; a map of one file without metadata may have {limit >> 20}",
            path=path,
            cause="needs_dividing",
            hint=_divided_hint(path) or "divide it into cells: shmmap divide",
        )

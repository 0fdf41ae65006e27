# SPDX-License-Identifier: Apache-2.0
"""Where the points of a picture come from: files, a published map, a live map's directory, or a daemon.

A source gives its points block by block, once or several times, so that memory stays that of one block.
"""

from __future__ import annotations

import contextlib
import math
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from shmmap.columns import Bounds
from shmmap.errors import BadRequest, NoColumn
from shmmap.formats.cloud import cloud_suffix, open_blocks
from shmmap.formats.coordinate_system import GEOGRAPHIC_SYSTEM, METRE, CoordinateSystem
from shmmap.formats.pcd.reader import PcdReader
from shmmap.formats.source_file import refusal
from shmmap.geometry import Box
from shmmap.quantities import counted

if TYPE_CHECKING:
    from shmmap.client.cell import Cell
    from shmmap.client.client import Client
    from shmmap.client.map_listing import MapListing
    from shmmap.errors import CellError
    from shmmap.live_worker.disk.stored_map import StoredMap
    from shmmap.origin.remote.map_versions import Current
    from shmmap.origin.remote.store import Store

BoxTuple: TypeAlias = tuple[float, float, float, float]
Columns: TypeAlias = Mapping[str, NDArray[Any]]
HeightRange: TypeAlias = tuple[float, float]

_NO_ORIGIN: Final = (0.0, 0.0, 0.0)
_BLOCK_POINTS: Final = 1 << 18
_BATCH: Final = 16  # cells that are mapped at a time
_INTENSITY: Final = "intensity"


class Points(NamedTuple):
    """A block of points: (N, 3), metres, relative to ``origin``; the values of a column, (N,), if any."""

    xyz: NDArray[Any]
    origin: tuple[float, float, float]
    values: NDArray[Any] | None

    def thinned(self, every: int) -> Points:
        """Return one of ``every`` points."""
        values = None if self.values is None else self.values[::every]
        return Points(self.xyz[::every], self.origin, values)


class PointSource(ABC):
    """Points to draw.

    Attributes
    ----------
    title
        Name of the map or the files.
    what
        The parts that are counted: ``cell``, ``file`` or ``chunk``.
    parts
        Number of parts read by the last `blocks`.
    unit
        Unit of the column of the last `blocks`; empty if unknown.
    problems
        Parts that could not be read, one sentence each.
    """

    what = "cell"

    def __init__(self, title: str) -> None:
        self.title = title
        self.parts = 0
        self.unit = ""
        self.problems: list[str] = []

    @abstractmethod
    def extent(self) -> BoxTuple | None:
        """Return the bounds of all points or cells, metres; None if there are none."""

    @abstractmethod
    def blocks(self, area: Box, column: str) -> Iterator[Points]:
        """Yield the points of the parts that touch an area, with the values of a column unless it is empty.

        Raises
        ------
        NoColumn
            There is no such column; the hint lists those there are.
        """

    def heights(self, area: Box) -> HeightRange | None:
        """Return the lowest and highest z in an area, metres; None if there is no point."""
        low, high = math.inf, -math.inf
        for points in self.blocks(area, ""):
            x, y, z = (points.xyz[:, axis] + points.origin[axis] for axis in range(3))
            z = z[(x >= area.min_x) & (x <= area.max_x) & (y >= area.min_y) & (y <= area.max_y)]
            z = z[np.isfinite(z)]
            if len(z):
                low, high = min(low, float(z.min())), max(high, float(z.max()))
        return (low, high) if low <= high else None


def values_of(columns: Columns, column: str, rows: int, where: str) -> NDArray[Any] | None:
    """Return the values of a column, (N,); ``name[k]`` is the k-th value of each row of a wide column.

    Raises
    ------
    NoColumn
        There is no such column.
    BadRequest
        The column has several values a point, or none.
    """
    if not column:
        return None
    name, _, index = column.removesuffix("]").partition("[")
    if name not in columns:
        raise NoColumn(f"{where} has no column {name!r}", hint=f"it has {', '.join(columns)}")
    values = columns[name]
    if len(values) != rows:
        raise BadRequest(f"{where}: column {name!r} has no value for each of its {rows:,} points")
    wide = math.prod(values.shape[1:])
    if index or wide > 1:
        if not index.isdecimal() or int(index) >= wide:
            raise BadRequest(
                f"{where}: column {name!r} has {counted(wide, 'value')} a point",
                hint=f"name one of them, {name}[0]" + (f" to {name}[{wide - 1}]" if wide > 1 else ""),
            )
        values = values.reshape(rows, wide)[:, int(index)]
    return values.reshape(rows)


# --- files ----------------------------------------------------------------------------------------------


class _CloudFiles(PointSource):
    """Cloud files of any format; or the cells of a divided map, whose boxes are known.

    Coordinates in a unit that a file states are converted to metres.
    """

    def __init__(
        self, title: str, path: Callable[[int], str], count: int, boxes: NDArray[np.float64] | None = None
    ) -> None:
        super().__init__(title)
        self.what = "file" if boxes is None else "cell"
        self._path = path
        self._count = count
        self._boxes = boxes
        self._bounds: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None

    def extent(self) -> BoxTuple | None:
        if self._boxes is not None and len(self._boxes):
            low, high = self._boxes[:, :2].min(axis=0), self._boxes[:, 2:].max(axis=0)
        else:
            low, high = self._whole()
        if not np.isfinite(low).all():
            return None
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])

    def heights(self, area: Box) -> HeightRange | None:
        if self._bounds is not None:
            low, high = self._bounds
            if (
                area.min_x <= low[0]
                and high[0] <= area.max_x
                and area.min_y <= low[1]
                and high[1] <= area.max_y
            ):
                return float(low[2]), float(high[2])
        return super().heights(area)

    def _whole(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Read the bounds of all points."""
        if self._bounds is None:
            bounds = Bounds()
            for index in range(self._count):
                for block in _blocks_of(self._path(index)):
                    bounds.add(np.ascontiguousarray(block["xyz"]))
            self._bounds = bounds.result()
        return self._bounds

    def blocks(self, area: Box, column: str) -> Iterator[Points]:
        self.parts = 0
        chosen = np.arange(self._count)
        if self._boxes is not None:
            chosen = np.flatnonzero(area.overlaps(self._boxes))
        for index in chosen.tolist():
            path = self._path(index)
            self.parts += 1
            for block in _blocks_of(path):
                yield Points(
                    block["xyz"],
                    _NO_ORIGIN,
                    values_of(block, column, len(block["xyz"]), os.path.basename(path)),
                )


def _blocks_of(path: str) -> Iterator[Columns]:
    """Yield the columns of a cloud, coordinates in metres."""
    suffix = cloud_suffix(path)
    if suffix == ".pcd":
        with PcdReader(path) as reader:
            scale = _metres(path, reader.header.crs)
            for block in reader.named_blocks(0):
                yield _scaled(block, scale)
        return
    with open_blocks(path, suffix) as reader:
        scale = _metres(path, reader.crs)
        for block in reader.blocks(_BLOCK_POINTS):
            yield _scaled(block, scale)


def _metres(path: str, crs: CoordinateSystem | None) -> tuple[float, float]:
    """Return the metres per unit in the plane and in height; refuse degrees, which no factor converts."""
    if crs is None:
        return METRE.metres, METRE.metres
    if crs.geographic:
        raise refusal(
            "not_metres",
            GEOGRAPHIC_SYSTEM,
            path=path,
            hint="convert it to a metric system first, such as UTM",
        )
    plane, height = crs.units
    return plane.metres or 1.0, height.metres or 1.0


def _scaled(block: Columns, scale: tuple[float, float]) -> Columns:
    if scale == (1.0, 1.0):
        return block
    return {**block, "xyz": block["xyz"].astype(np.float64) * (scale[0], scale[0], scale[1])}


class _LiveFiles(PointSource):
    """The occupied voxels of a live map, as saved; ``intensity`` is their probability."""

    what = "chunk"

    def __init__(self, stored: StoredMap) -> None:
        super().__init__(f"live map {stored.path}, voxels of {stored.settings.resolution:g} m")
        self._stored = stored
        resolution = stored.settings.resolution
        self._boxes = {key: key.box(resolution) for key, row in sorted(stored.rows.items()) if row.occupied}

    def extent(self) -> BoxTuple | None:
        if not self._boxes:
            return None
        boxes = np.array(list(self._boxes.values()))
        low, high = boxes[:, :3].min(axis=0), boxes[:, 3:].max(axis=0)
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])

    def blocks(self, area: Box, column: str) -> Iterator[Points]:
        from shmmap.chunks.occupancy import UNIT
        from shmmap.chunks.voxels import voxel_centers, voxels_of

        self.parts = 0
        for key, box in self._boxes.items():
            if not area.overlaps(np.array([(*box[:2], *box[3:5])]))[0]:
                continue
            self.parts += 1
            view = self._stored.chunk(key)
            log_odds = view.dense()
            places = np.flatnonzero(log_odds > view.identity.occupied_above)
            columns = {
                "xyz": voxel_centers(voxels_of(key, places), self._stored.settings.resolution),
                _INTENSITY: 1.0 / (1.0 + np.exp(log_odds[places] / -float(UNIT))),
            }
            yield Points(columns["xyz"], _NO_ORIGIN, values_of(columns, column, len(places), "a live map"))


def _range_of(heights: NDArray[np.float64]) -> HeightRange | None:
    """Return the heights of all cells, given those of each, (N, 2); None if none is known."""
    known = heights[np.isfinite(heights).all(axis=1)]
    return (float(known[:, 0].min()), float(known[:, 1].max())) if len(known) else None


class _PublishedMap(PointSource):
    """The points of a published map, whose objects are fetched and verified."""

    def __init__(self, store: Store, current: Current | None) -> None:
        from shmmap.origin.remote.map_versions import read_root, read_shards, require_current
        from shmmap.origin.remote.object_tier import KeptObjects

        current = current or require_current(store)
        super().__init__(f"{store.url}, version {current.version}")
        pages = KeptObjects(store, None, is_index=True, keep=False)
        self._objects = KeptObjects(store, None, keep=False)
        self._root = read_root(pages, current)
        self._shards = list(read_shards(pages, self._root))

    def extent(self) -> BoxTuple | None:
        return self._root.bounds

    def heights(self, area: Box) -> HeightRange | None:
        z = [shard.z[area.overlaps(shard.boxes)] for shard in self._shards]
        return _range_of(np.concatenate([*z, np.empty((0, 2))]))

    def blocks(self, area: Box, column: str) -> Iterator[Points]:
        from shmmap.origin.remote.published_object import POINTS, read_bare_header, rows_of
        from shmmap.origin.remote.zstd_frame import unpack_frame

        self.parts = 0
        for shard in self._shards:
            for index in np.flatnonzero(area.overlaps(shard.boxes)):
                self.parts += 1
                source = shard.layers[POINTS].name(int(index))
                frame = self._objects.read(source.sha256, source.size)
                unpacked = unpack_frame(frame, source.raw, name=source.path, exact=True)
                header = read_bare_header(unpacked, POINTS, name=source.path)
                needed = {"xyz", column.partition("[")[0]}
                columns = {
                    one.name: rows_of(unpacked, one) if one.name in needed else np.empty(0)
                    for one in header.columns
                }
                units = {one.name: one.unit for one in header.columns}
                self.unit = units.get(column.partition("[")[0], "")
                where = os.fsdecode(shard.names[int(index)])
                yield Points(
                    columns["xyz"], header.origin, values_of(columns, column, len(columns["xyz"]), where)
                )


def published_points(store: Store, current: Current | None = None) -> PointSource:
    """Return the points of a published map.

    Parameters
    ----------
    current
        The version, if it was verified; None: the current one.

    Raises
    ------
    MapMissing, MapDataError, Offline
        There is no map, a page of it is damaged, or the store does not answer.
    """
    return _PublishedMap(store, current)


@contextlib.contextmanager
def open_files(paths: Sequence[str]) -> Iterator[PointSource]:
    """Open clouds, directories of clouds, one divided map, or one live map's directory.

    Raises
    ------
    MapMissing
        There is nothing to draw at a path.
    MapDataError
        A file is damaged, or of an unknown format.
    """
    from shmmap.dividing.inputs import find_inputs
    from shmmap.live_worker.disk.map_record import MAP_FILE
    from shmmap.live_worker.disk.schema import DATABASE
    from shmmap.live_worker.disk.stored_map import opened_map
    from shmmap.origin.map_directory import open_map

    first = paths[0]
    if len(paths) == 1 and os.path.isdir(first):
        if any(os.path.isfile(os.path.join(first, name)) for name in (DATABASE, MAP_FILE)):
            with opened_map(first) as stored:
                yield _LiveFiles(stored)
            return
        if _has_metadata(first):
            catalogue = open_map(first).load()
            yield _CloudFiles(first, catalogue.id, len(catalogue), catalogue.boxes)
            return
    files = [file.path for file in find_inputs(paths)]
    title = first if len(paths) == 1 else f"{first} and {len(paths) - 1} more"
    yield _CloudFiles(title, files.__getitem__, len(files))


def _has_metadata(path: str) -> bool:
    """Whether a directory is a divided map."""
    from shmmap.errors import MapDataError, MapMissing
    from shmmap.origin.map_layout import absolute_path, find_layout

    try:
        return find_layout(absolute_path(path), None).metadata is not None
    except (MapDataError, MapMissing):
        return False


# --- a daemon -------------------------------------------------------------------------------------------


class _ServedCells(PointSource):
    """Cells as the daemon serves them, a few at a time."""

    def __init__(self, client: Client, layer: str, wait_s: float, ids: Sequence[str] | None = None) -> None:
        named = "" if layer == "points" else f", layer {layer}"
        super().__init__(f"{client.welcome.map_path}{named}")
        self._client = client
        self._layer = layer
        self._wait_s = wait_s
        self._ids = ids
        self._listed: tuple[Box, MapListing] | None = None

    def extent(self) -> BoxTuple | None:
        return self._client.bounds

    def cells(self, area: Box) -> MapListing:
        """Return the cells that touch an area, and reach into its heights as far as these are known."""
        if self._listed is None or self._listed[0] != area:
            self._listed = area, self._client.metadata(area)
        return self._listed[1]

    def heights(self, area: Box) -> HeightRange | None:
        known = [one.z_bounds for one in self.cells(area)]
        if None in known:
            known = [cell.z_bounds for cell in self._attached(area)]
        return _range_of(np.array([one for one in known if one is not None]).reshape(-1, 2))

    def blocks(self, area: Box, column: str) -> Iterator[Points]:
        self.parts = 0
        for cell in self._attached(area):
            self.parts += 1
            yield self._points(cell, column)

    def _attached(self, area: Box) -> Iterator[Cell]:
        from shmmap.lacking import failure_lines

        failed: list[CellError] = []
        pending: list[str] = []
        cells = self.cells(area) if self._ids is None else self._ids
        for start in range(0, len(cells), _BATCH):
            some = cells[start : start + _BATCH]
            found = self._client.selected(
                [one if isinstance(one, str) else one.id for one in some],
                layers=(self._layer,),
                wait=self._wait_s,
                strict=None,
            )
            failed += found.failed
            pending += [f"{one.id}: not loaded within {self._wait_s:g} s" for one in found.pending]
            self.problems = failure_lines(failed) + pending
            attached = list(found.cells)
            del found
            while attached:  # a cell that has been drawn is mapped no more
                yield attached.pop()

    def _points(self, cell: Cell, column: str) -> Points:
        where = f"{cell.name}: layer {cell.layer}"
        columns = _Lazily(cell)
        name = column.partition("[")[0]
        if name in cell.column_names:
            self.unit = cell.unit(name)
        lattice, grid = cell.lattice, columns.get("min")
        if "xyz" not in columns and lattice is not None and grid is not None and grid.ndim == 2:
            z = cell[name] if name in ("mean", "max") else grid
            if name and name not in columns:
                values_of(columns, name, 0, where)  # raises
            values = cell[name] if name else None
            rows, across = grid.shape
            x = (np.arange(across) + lattice.first[0] + 0.5) * lattice.leaf[0]
            y = (np.arange(rows) + lattice.first[1] + 0.5) * lattice.leaf[1]
            xyz = np.column_stack((np.tile(x, rows), np.repeat(y, across), z.reshape(-1)))
            return Points(xyz, cell.origin, None if values is None else values.reshape(-1))
        place = columns["xyz"] if "xyz" in columns else columns.get("mean")
        if place is None or place.shape[1:] != (3,):
            raise BadRequest(
                f"{where} has neither points nor heights to draw",
                hint="draw points, or a layer voxel, ndt, normals, ground, elevation",
            )
        return Points(place, cell.origin, values_of(columns, column, len(place), where))


def served_points(
    client: Client, layer: str, wait_s: float, *, ids: Sequence[str] | None = None
) -> PointSource:
    """Return the points that a daemon serves; it loads cells that are not in memory.

    Parameters
    ----------
    layer
        The layer to draw: one with points, voxels, or a grid of heights.
    wait_s
        How long a few cells at a time may take to load, seconds.
    ids
        The cells, wherever they are; None: those of each area.
    """
    return _ServedCells(client, layer, wait_s, ids)


class _Lazily(Mapping[str, "NDArray[Any]"]):
    """A cell's columns, attached when they are read."""

    def __init__(self, cell: Cell) -> None:
        self._cell = cell

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self._cell[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._cell.column_names)

    def __len__(self) -> int:
        return len(self._cell.column_names)

# SPDX-License-Identifier: Apache-2.0
"""Elevation of the whole map, one cell at a time: list, load by id, reduce to columns, release."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest, Cell, CellError, CellInfo, Client, LoadTimeout, MapListing, ShmmapError
from shmmap.errors import InstanceBusy, MapMissing
from shmmap.formats.npz_writer import write_npz
from shmmap.private_directory import open_own, require_private
from shmmap_clients.elevation_map import surface
from shmmap_clients.elevation_map.grid import ElevationGrid
from shmmap_clients.elevation_map.heights import ElevationRule
from shmmap_clients.elevation_map.seams import ColumnBox, Columns, Seams, column_boxes

_APART_M: Final = 1000.0  # cells nearer than about this distance are in one part of the map
_SHARE: Final = 0.01  # share of the map's bytes: a larger part is not a stray point
_FEW_BYTES: Final = 4096
_LARGER: Final = 4.0  # factor: unless the box grows by more, nothing is left out
_MIN, _MAX, _MEAN, _COUNT = range(4)
FORMAT: Final = 3
_EVERY: Final = 64  # cells between checkpoints


def far_cells(boxes: NDArray[np.float64], sizes: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the distance of each nearly empty outlying cell from the map; 0 for all other cells.

    A stray point or two can create such a cell.  A grid covers the box around its cells, and one point
    kilometres off would make it a thousand times as large.

    Parameters
    ----------
    boxes
        (N, 4) float64: min_x, min_y, max_x, max_y, metres.
    sizes
        (N,) int64: bytes of the cells' sources.

    Returns
    -------
    (N,) float64, metres to the nearest cell of the map; 0 for the map's own cells.
    """
    parts = _parts(boxes)
    held = np.bincount(parts, weights=sizes if sizes.any() else np.ones(len(sizes)))
    few = min(max(_SHARE * held.sum(), _FEW_BYTES), held.max() / 10)
    own = (held > few)[parts]
    far = np.zeros(len(boxes))
    if own.all() or _extent(boxes) < _LARGER * _extent(boxes[own]):
        return far
    for number in np.flatnonzero(~own):
        box = boxes[number]
        gap = np.maximum(np.maximum(boxes[own, :2] - box[2:], box[:2] - boxes[own, 2:]), 0.0)
        far[number] = float(np.hypot(gap[:, 0], gap[:, 1]).min())
    return far


def _extent(boxes: NDArray[np.float64]) -> float:
    """Return the area of the box around boxes, square metres; a line counts as a metre wide."""
    sides = boxes[:, 2:].max(axis=0) - boxes[:, :2].min(axis=0)
    return float(np.maximum(sides, 1.0).prod())


def _parts(boxes: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the number of the map part of each cell, from 0; squares that touch are one part."""
    edge = max(_APART_M, float((boxes[:, 2:] - boxes[:, :2]).max()))
    squares, member = np.unique(
        np.floor((boxes[:, :2] + boxes[:, 2:]) / (2 * edge)).astype(np.int64), axis=0, return_inverse=True
    )
    number = {(i, j): place for place, (i, j) in enumerate(squares.tolist())}
    part = np.full(len(squares), -1, np.int64)
    count = 0
    for start in range(len(squares)):
        if part[start] >= 0:
            continue
        part[start] = count
        ahead = [start]
        while ahead:
            i, j = squares[ahead.pop()].tolist()
            for near in ((i + di, j + dj) for di in (-1, 0, 1) for dj in (-1, 0, 1)):
                place = number.get(near)
                if place is not None and part[place] < 0:
                    part[place] = count
                    ahead.append(place)
        count += 1
    return part[member.reshape(-1)]


def _columns_of(cell: Cell, rule: ElevationRule) -> Columns:
    """Return a cell's points, (N, 3), or its ``elevation`` layer: min, max, mean, count, (N, 4) float64."""
    if rule.name == "surface":
        xyz = cell.xyz if not any(cell.origin) else cell.xyz.astype(np.float64) + cell.origin
        index = np.floor(xyz[:, :2].astype(np.float64) * (1.0 / rule.resolution)).astype(np.int64)
        return Columns(index[:, 0], index[:, 1], xyz)
    lattice = cell.header.lattice
    if lattice is None:
        raise BadRequest(f"{cell.id}: layer {cell.layer} has no lattice")
    count = cell["count"]
    j, i = np.nonzero(count)
    values = np.stack([cell[name][j, i].astype(np.float64) for name in ("min", "max", "mean")], axis=1)
    values = np.column_stack([values, count[j, i].astype(np.float64)])
    return Columns(i + lattice.first[0], j + lattice.first[1], values)


def _heights_of(
    rows: Columns, rule: ElevationRule
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Return columns i and j, (M,), and their heights, (M,) float64 metres, from all their rows."""
    low_i, low_j = int(rows.i.min()), int(rows.j.min())
    width = int(rows.i.max()) - low_i + 1
    key = (rows.j - low_j) * width + (rows.i - low_i)
    if rule.name == "surface":
        columns, heights = surface.surface_heights(rows.values, key, rule)
    else:
        columns, member = np.unique(key, return_inverse=True)
        member = member.reshape(-1)
        if rule.name == "mean":
            points = np.bincount(member, weights=rows.values[:, _COUNT])
            sums = np.bincount(member, weights=rows.values[:, _MEAN] * rows.values[:, _COUNT])
            heights = sums / points
        else:
            lowest = rule.name == "min"
            heights = np.full(len(columns), np.inf if lowest else -np.inf)
            ufunc = np.minimum if lowest else np.maximum
            ufunc.at(heights, member, rows.values[:, _MIN if lowest else _MAX])
    return columns % width + low_i, columns // width + low_j, heights


@dataclass(slots=True)
class Checkpoint:
    """Counts at a checkpoint: cells done, rows read, points outside their cell, columns with a point."""

    done: int = 0
    rows: int = 0
    stray: int = 0
    occupied: int = 0


class Journal:
    """Storage of a build's latest checkpoint, in its directory.

    Heights and ``seams-N.npz`` are synced to the disk first, then ``state.json`` with N appears by rename.
    So whenever a build or its machine stops, the state refers to complete files.  Columns finished after a
    checkpoint are computed again, with the same heights.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory

    def write(self, state: Checkpoint, seams: Seams) -> None:
        """Replace the checkpoint."""
        arrays = {}
        for number, rows in seams.waiting.items():
            arrays[f"i{number}"], arrays[f"j{number}"] = rows.i, rows.j
            arrays[f"values{number}"] = rows.values
        with open(self._directory / f"seams-{state.done}.npz", "wb") as file:
            write_npz(file, arrays)
            file.flush()
            os.fsync(file.fileno())
        with open(self._directory / "heights", "rb") as heights:
            os.fsync(heights.fileno())
        interim = self._directory / "state.json.tmp"
        interim.write_text(json.dumps(asdict(state)), encoding="utf-8")
        interim.replace(self._directory / "state.json")
        for path in self._directory.glob("seams-*.npz"):
            if path.name != f"seams-{state.done}.npz":
                path.unlink()

    def read(self, seams: Seams) -> Checkpoint | None:
        """Return the latest checkpoint and fill ``seams`` from it; None if there is no valid one."""
        try:
            state = Checkpoint(**json.loads((self._directory / "state.json").read_text(encoding="utf-8")))
            with np.load(self._directory / f"seams-{state.done}.npz", allow_pickle=False) as archive:
                waiting = {
                    int(name[1:]): Columns(
                        archive[name], archive[f"j{name[1:]}"], archive[f"values{name[1:]}"]
                    )
                    for name in archive.files
                    if name.startswith("i")
                }
        except (OSError, ValueError, TypeError, KeyError, zipfile.BadZipFile):
            return None
        if not (self._directory / "heights").exists():
            return None
        seams.waiting.update(waiting)
        return state


class MapChanged(ShmmapError):
    """The map changed during the build, which must begin again."""

    code = "map_changed"
    exit_code = 75


@dataclass(frozen=True, slots=True)
class BuildProgress:
    """Progress of a build: cells done of all, and points (or columns of layers) read."""

    done: int
    cells: int
    rows: int


@dataclass(frozen=True, slots=True)
class BuiltElevation:
    """A finished elevation map.

    Attributes
    ----------
    grid
        The heights.
    map_version
        Version of the map that was used.
    cells
        Number of cells of the map.
    loaded
        Number of cells that this call loaded; 0 if the cache had the whole elevation.
    occupied
        Number of columns with a point; under the ``surface`` rule not all of them have a height.
    stray
        Number of points left out because they lie outside the box of their cell.
    failed
        Cells that could not be loaded, and whose points are missing.
    far
        Cells left out because they are nearly empty and far from all others: id and distance, metres.
    """

    grid: ElevationGrid
    map_version: int
    cells: int
    loaded: int
    occupied: int
    stray: int
    failed: tuple[CellError, ...]
    far: tuple[tuple[str, float], ...] = ()


def _map_key(map_version: int, rule: ElevationRule) -> str:
    """Return the name under which a map's elevation is cached, 32 hex digits."""
    text = json.dumps([FORMAT, f"{map_version:016x}", rule.document], sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def build_elevation_map(
    client: Client,
    rule: ElevationRule,
    cache: Path,
    *,
    wait_s: float = 60.0,
    progress: Callable[[BuildProgress], None] | None = None,
) -> BuiltElevation:
    """Return the elevation of the daemon's whole map, from the cache or by a build.

    An interrupted build continues from its last checkpoint.

    Parameters
    ----------
    client
        Client of the daemon.
    rule
        Definition of heights.
    cache
        Directory, with a subdirectory for each map and rule.
    wait_s
        Time for one cell to load, seconds.
    progress
        Called after each cell.

    Raises
    ------
    MapMissing
        The map has no cells.
    MapChanged
        The map changed during the build.
    LoadTimeout
        A cell was not loaded in time.
    InstanceBusy
        Another run is building the same elevation in this cache.
    """
    listing = client.metadata()
    if not len(listing):
        raise MapMissing("the map has no cells")
    with _alone(cache, _map_key(listing.map_version, rule)) as directory:
        return _build(client, listing, rule, directory, wait_s, progress)


@contextlib.contextmanager
def _alone(cache: Path, key: str) -> Iterator[Path]:
    """Lock a directory of the cache, since concurrent runs would overwrite each other's heights."""
    require_private(cache / key)
    with open(open_own(str(cache / f"{key}.lock"), os.O_RDWR | os.O_CREAT), "r+b") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InstanceBusy(
                f"another run is making this elevation in {cache}", hint="wait for it, or use another cache"
            ) from None
        yield cache / key


def _build(
    client: Client,
    listing: MapListing,
    rule: ElevationRule,
    directory: Path,
    wait_s: float,
    progress: Callable[[BuildProgress], None] | None,
) -> BuiltElevation:
    # row after row, so that only the strip between two rows has to wait
    metres = listing.boxes
    away = far_cells(metres, np.array([info.source_bytes for info in listing], np.int64))
    far = tuple((listing[n].id, float(away[n])) for n in np.flatnonzero(away).tolist())
    order = np.lexsort((metres[:, 0], metres[:, 1]))
    order = order[away[order] == 0.0]
    boxes = column_boxes(metres[order], rule.resolution)
    first = (int(boxes[:, 0].min()), int(boxes[:, 1].min()))
    shape = (int(boxes[:, 3].max()) - first[1], int(boxes[:, 2].max()) - first[0])
    grid = ElevationGrid(directory / "heights", rule.resolution, first, shape, boxes)
    journal = Journal(directory)
    seams = Seams(boxes)
    state = journal.read(seams)
    if state is None:
        for left in directory.iterdir():
            left.unlink()
        ElevationGrid.create(grid.path, rule.resolution, first, shape)
        state = Checkpoint()
    failed: list[CellError] = []
    begun = state.done
    for number in range(state.done, len(order)):
        if number + 1 < len(order):  # the daemon loads it while we compute
            client.selected((listing[order[number + 1]].id,), rule.layer, wait=None, strict=None)
        cell = _load(client, listing[order[number]], rule.layer, wait_s, failed, listing.map_version)
        rows = None
        if cell is not None:
            rows = _columns_of(cell, rule)
            state.rows += len(rows)
            inside = rows.inside(ColumnBox(*boxes[number].tolist()))
            if not inside.all():
                state.stray += int((~inside).sum())
                rows = rows.where(inside)
        complete = seams.add(number, rows)
        del rows, cell
        if complete is not None:
            i, j, heights = _heights_of(complete, rule)
            state.occupied += len(i)
            grid.put(i, j, heights)
        state.done = number + 1
        if not failed and (state.done % _EVERY == 0 or state.done == len(order)):
            journal.write(state, seams)
        if progress is not None:
            progress(BuildProgress(state.done, len(order), state.rows))
    client.release()
    loaded = len(order) - begun
    return BuiltElevation(
        grid, listing.map_version, len(listing), loaded, state.occupied, state.stray, tuple(failed), far
    )


def _load(
    client: Client, info: CellInfo, layer: str, wait_s: float, failed: list[CellError], map_version: int
) -> Cell | None:
    """Load a cell in the listed map version; on failure, append to ``failed`` and return None."""
    answer = client.selected((info.id,), layer, wait=wait_s, strict=None)
    if answer.failed:
        failed += answer.failed
        return None
    if answer.pending:
        raise LoadTimeout(
            f"{info.id} ({layer}): not loaded within {wait_s:g} s", cell_id=info.id, layer=layer
        )
    if answer.map_version != map_version:
        raise MapChanged("the map changed while its elevation was being made", hint="begin again")
    return answer.cells[0]

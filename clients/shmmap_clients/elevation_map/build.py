# SPDX-License-Identifier: Apache-2.0
"""The whole map, one cell at a time: list, load by id, reduce to columns, let go."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from shmmap import (
    Cell,
    CellError,
    CellInfo,
    Client,
    InstanceBusy,
    LoadTimeout,
    MapListing,
    MapMissing,
    ShmmapError,
)
from shmmap_clients.elevation_map.cell_columns import columns_of, heights_of
from shmmap_clients.elevation_map.checkpoint import Checkpoint, Journal
from shmmap_clients.elevation_map.far_cells import far_cells
from shmmap_clients.elevation_map.grid import ElevationGrid
from shmmap_clients.elevation_map.rule import ElevationRule
from shmmap_clients.elevation_map.seams import ColumnBox, Seams, column_boxes

__all__ = ["BuildProgress", "BuiltElevation", "MapChanged", "build_elevation_map"]

FORMAT: Final = 3
_EVERY: Final = 64  # cells between checkpoints


class MapChanged(ShmmapError):
    """The map changed while its elevation was being made: begin again."""

    code = "map_changed"
    exit_code = 75


@dataclass(frozen=True, slots=True)
class BuildProgress:
    """How far a build is: cells done of all, and points (or columns of layers) read."""

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
        State of the map that it is of.
    cells
        Cells of the map.
    loaded
        Of those, how many this call had to load: 0 where the cache had it all.
    occupied
        Columns with a point; in the ``surface`` rule not all of them have a height.
    stray
        Points left out because they lie outside the box of their cell.
    failed
        Cells that could not be loaded; what they hold is missing.
    far
        Ids of cells that were left out, for they lie far from all others and hold next to nothing, and how
        far, metres.
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
    """Return the elevation of the daemon's whole map; made only where the cache does not have it.

    A build that was interrupted continues from its last checkpoint.

    Parameters
    ----------
    client
        Whom to ask.
    rule
        What a height is.
    cache
        Directory; each map and rule has its own inside.
    wait_s
        How long one cell may take.
    progress
        Called after each cell.

    Raises
    ------
    MapMissing
        The map has no cells.
    MapChanged
        It changed meanwhile.
    LoadTimeout
        A cell was not there in time.
    InstanceBusy
        Another run is making the same elevation in this cache.
    """
    listing = client.metadata()
    if not len(listing):
        raise MapMissing("the map has no cells")
    with _alone(cache, _map_key(listing.map_version, rule)) as directory:
        return _build(client, listing, rule, directory, wait_s, progress)


@contextlib.contextmanager
def _alone(cache: Path, key: str) -> Iterator[Path]:
    """Hold a directory of the cache: two runs at a time would write over each other's heights."""
    cache.mkdir(parents=True, exist_ok=True)
    with open(cache / f"{key}.lock", "wb") as file:
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
    # row after row: only the strip between two rows has to wait
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
        shutil.rmtree(directory, ignore_errors=True)
        directory.mkdir(parents=True)
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
            rows = columns_of(cell, rule)
            state.rows += len(rows)
            inside = rows.inside(ColumnBox(*boxes[number].tolist()))
            if not inside.all():
                state.stray += int((~inside).sum())
                rows = rows.where(inside)
        complete = seams.add(number, rows)
        del rows, cell
        if complete is not None:
            i, j, heights = heights_of(complete, rule)
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
    """The cell in the state of the map that was listed; None if it cannot be loaded, which is remembered."""
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

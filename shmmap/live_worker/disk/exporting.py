# SPDX-License-Identifier: Apache-2.0
"""Export the voxels of a saved live map as a cloud, or as a divided map that can be served.

A point lies at the centre of its voxel.  Its ``intensity`` is the probability that the voxel is occupied.
Chunks are read and written one by one.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from typing import Any, Final, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from shmmap.chunks.layout import ChunkView
from shmmap.chunks.occupancy import UNIT
from shmmap.chunks.voxels import ChunkKey, voxel_centers, voxels_of
from shmmap.dividing.divide import divide
from shmmap.dividing.frame import Frame, Translation, frame_between
from shmmap.dividing.inputs import check_output_directory
from shmmap.dividing.lattice import CellLattice
from shmmap.dividing.settings import DivideSettings
from shmmap.errors import BadRequest, MapDataError
from shmmap.formats.durable_file import appearing_file, writing_errors
from shmmap.formats.pcd.writer import pcd_header
from shmmap.formats.ply_header import ply_header
from shmmap.live_worker.disk.map_record import Row
from shmmap.live_worker.disk.stored_map import StoredMap
from shmmap.quantities import counted

Format = Literal["ply", "pcd", "map"]
Voxels = Literal["occupied", "free", "both"]

_MAX_POINTS: Final = (1 << 32) - 1  # of a PCD file
_INTENSITY: Final = "intensity"


class ExportedVoxels(msgspec.Struct, frozen=True):
    """Result of an export.

    Attributes
    ----------
    voxels, chunks
        Number of exported voxels, and of chunks that contain them.
    cells
        Cells of a divided map, else 0.
    resolution, frame_id
        Edge of a voxel, metres; frame of the live map.
    origin
        Offset from exported points to that frame, metres.
    fields
        Names and dtypes of the columns.
    lost
        Chunks of which something that was saved is lost, and left out.
    """

    path: str
    format: Format
    voxels: int
    chunks: int
    cells: int
    resolution: float
    frame_id: str
    origin: tuple[float, float, float]
    fields: list[tuple[str, str]]
    lost: list[str]


def export(
    stored: StoredMap,
    out: str | os.PathLike[str],
    kind: Format,
    *,
    voxels: Voxels = "occupied",
    translate: Translation = "auto",
    cell_size: float = 20.0,
    force: bool = False,
) -> ExportedVoxels | None:
    """Write voxels to ``out``, which appears complete or not at all; return None if there are no voxels.

    Parameters
    ----------
    stored
        The live map; a daemon may be using it.
    voxels
        Kind of voxels; known voxels that are neither occupied nor free are left out.
    translate
        As in `DivideSettings`.
    cell_size
        Edge of the cells of a divided map, metres.
    force
        Replace an existing file, or a directory if it is a divided map.

    Raises
    ------
    BadRequest
        ``out`` exists, or a setting is invalid.
    MapDataError
        A chunk is damaged; or there are no voxels, and something is lost.
    CannotWrite
        The disk is full or not writable.
    """
    path = os.path.abspath(out)
    lattice = CellLattice.of(cell_size)
    if kind == "map":
        check_output_directory(path, force=force)
    elif os.path.isdir(path) or (os.path.lexists(path) and not force):
        raise BadRequest(f"{path} exists", hint="give another name, or --force to overwrite a file")
    keys = _keys(stored.rows, voxels)
    lost = [key.text for key in sorted(stored.lost)]
    if not keys and lost:
        raise MapDataError(
            f"no {voxels} voxel is left, and something is lost of {counted(len(lost), 'chunk')}",
            path=stored.path,
            hint="`shmmap live fsck` names what is lost",
        )
    if not keys:
        return None
    frame = frame_between(
        _bounds(keys, stored.settings.resolution),
        np.dtype(np.float64),
        lattice,
        "none" if kind == "map" else translate,  # dividing translates, and records the offset
    )
    parent, name = os.path.split(path)
    with writing_errors(path):
        os.makedirs(parent, exist_ok=True)
        if kind == "map":
            with tempfile.TemporaryDirectory(prefix=f".{name}.voxels-", dir=parent) as scratch:
                cloud = os.path.join(scratch, f"{os.path.basename(stored.path) or 'live'}.pcd")
                count, chunks = _write_cloud(stored, cloud, "pcd", keys, voxels, frame, replace=False)
                settings = DivideSettings(cell_size=cell_size, translate=translate, force=force)
                made = divide([cloud], path, settings)
            cells, origin, fields = made.cells, made.origin, made.fields
        else:
            count, chunks = _write_cloud(stored, path, kind, keys, voxels, frame, replace=force)
            cells, origin = 0, frame.origin
            row = _row(frame)
            fields = [(column, row[column].str) for column in row.names or ()]
    return ExportedVoxels(
        path=path,
        format=kind,
        voxels=count,
        chunks=chunks,
        cells=cells,
        resolution=stored.settings.resolution,
        frame_id=stored.settings.frame_id,
        origin=origin,
        fields=fields,
        lost=lost,
    )


# --- which voxels -----------------------------------------------------------------------------------


def _keys(rows: dict[ChunkKey, Row], voxels: Voxels) -> list[ChunkKey]:
    """Return the chunks that contain such voxels, in order."""

    def has_some(row: Row) -> bool:
        counted = {"occupied": row.occupied, "free": row.free, "both": row.occupied + row.free}
        return counted[voxels] > 0

    return sorted(key for key, row in rows.items() if has_some(row))


def _bounds(keys: list[ChunkKey], resolution: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    boxes = np.array([key.box(resolution) for key in keys])
    return boxes[:, :3].min(axis=0), boxes[:, 3:].max(axis=0)


def _row(frame: Frame) -> np.dtype[np.void]:
    return np.dtype([*((axis, frame.axis) for axis in "xyz"), (_INTENSITY, np.dtype("<f4"))])


def _points(
    key: ChunkKey, view: ChunkView, resolution: float, voxels: Voxels, frame: Frame
) -> NDArray[np.void]:
    """Return the voxels of a chunk as points, ordered by position."""
    identity = view.identity
    log_odds = view.dense()
    chosen = np.zeros(len(log_odds), bool)
    if voxels != "free":
        chosen |= log_odds > identity.occupied_above
    if voxels != "occupied":
        chosen |= log_odds < identity.free_below
    places = np.flatnonzero(chosen)
    centers = voxel_centers(voxels_of(key, places), resolution)
    points = np.empty(len(places), _row(frame))
    for number, axis in enumerate("xyz"):
        points[axis] = centers[:, number] + frame.move[number]
    points[_INTENSITY] = 1.0 / (1.0 + np.exp(log_odds[places] / -float(UNIT)))
    return points


# --- files ------------------------------------------------------------------------------------------


def _write_cloud(
    stored: StoredMap,
    path: str,
    kind: Format,
    keys: list[ChunkKey],
    voxels: Voxels,
    frame: Frame,
    *,
    replace: bool,
) -> tuple[int, int]:
    """Write a file; return the number of voxels in it, and of their chunks.

    The header, which contains the number of voxels, is written last, into space reserved for it.
    """
    header = _header_of(kind, _row(frame), stored, frame)
    room = len(header(_MAX_POINTS, 0))
    count = chunks = 0
    with appearing_file(path, replace=replace) as file:
        file.write(bytes(room))
        for key in keys:
            points = _points(key, stored.chunk(key), stored.settings.resolution, voxels, frame)
            file.write(points.view(np.uint8).data)
            count += len(points)
            chunks += len(points) > 0
        file.seek(0)
        file.write(header(count, room))
    return count, chunks


def _header_of(
    kind: Format, row: np.dtype[np.void], stored: StoredMap, frame: Frame
) -> Callable[[int, int], bytes]:
    """Return a function that makes a header from the number of points and the header's length."""
    fields: list[tuple[str, np.dtype[Any]]] = [(name, row[name]) for name in row.names or ()]
    if kind == "ply":
        origin = " ".join(f"{part:.17g}" for part in frame.origin)
        comment = f"voxels of {stored.settings.resolution:.17g} m, origin {origin}"
        return lambda count, room: ply_header(fields, count, comment=comment, header_bytes=room)
    counted = [(name, dtype, 1) for name, dtype in fields]
    return lambda count, room: pcd_header(counted, count, "binary", header_bytes=room)

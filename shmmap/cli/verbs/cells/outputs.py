# SPDX-License-Identifier: Apache-2.0
"""JSON output of the verbs about cells; imported only for ``--json``."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated

import msgspec

from shmmap.cli.json_output import Box, Hex, Holder, Point, hexed

if TYPE_CHECKING:
    from shmmap.client.cell_set import CellSet
    from shmmap.formats.cloud import CloudDescription


class Reload(msgspec.Struct):
    """Changes of the map found by a reload."""

    map_version: Hex
    changed: Annotated[int, msgspec.Meta(description="cells whose file changed")]
    added: int
    removed: int
    problems: list[str]


class Eviction(msgspec.Struct):
    """Numbers of segments after an eviction."""

    freed: int
    still_mapped: Annotated[int, msgspec.Meta(description="retired, freed when no client maps them")]
    kept: Annotated[int, msgspec.Meta(description="in service, because an operator pinned them")]
    unknown: Annotated[list[str], msgspec.Meta(description="ids that the map does not have")]


class Stop(msgspec.Struct):
    """The daemon that is stopping."""

    stopping: Annotated[int, msgspec.Meta(description="its pid")]


class Pin(msgspec.Struct):
    """A pinned layer of a cell."""

    id: str
    layer: str
    state: Annotated[
        str, msgspec.Meta(description="resident, stale, loading, absent, or the code of its failure")
    ]
    bytes: int


class Pins(msgspec.Struct):
    """All pinned layers."""

    cells: list[Pin]
    unknown: Annotated[list[str], msgspec.Meta(description="ids that the map does not have")]


class FoundCell(msgspec.Struct):
    """Location of a layer of a cell in shared memory."""

    id: str
    version: Hex
    layer: str
    segment: str
    offset: int
    bytes: int
    points: int
    stale: bool
    box: Box


class PendingLayer(msgspec.Struct):
    """A layer of a cell that is still being loaded."""

    id: str
    layer: str


class FailedLayer(msgspec.Struct):
    """A layer of a cell that could not be loaded; if the budget is full, ``holders`` use its memory."""

    id: str
    layer: str
    code: str
    message: str
    holders: list[Holder]


class Found(msgspec.Struct):
    """The reply to a client's request for cells."""

    epoch: Hex
    map_version: Hex
    frame_id: str
    cells: list[FoundCell]
    removed: Annotated[list[str], msgspec.Meta(description="held ids that the client should drop")]
    pending: list[PendingLayer]
    failed: list[FailedLayer]

    @classmethod
    def of(cls, found: CellSet, frame_id: str) -> Found:
        """Return the JSON form of an answer."""
        return cls(
            hexed(found.epoch),
            hexed(found.map_version),
            frame_id,
            [
                FoundCell(
                    cell.id,
                    cell.version_hex,
                    cell.layer,
                    cell.segment,
                    cell.offset,
                    cell.nbytes,
                    cell.points,
                    cell.stale,
                    cell.box,
                )
                for cell in found.cells
            ],
            list(found.removed),
            [PendingLayer(cell.id, cell.layer) for cell in found.pending],
            [
                FailedLayer(
                    error.cell_id, error.layer, error.code, error.message, list(map(Holder.of, error.holders))
                )
                for error in found.failed
            ],
        )


class File(msgspec.Struct):
    """An exported file, and the ids of the cells in it."""

    path: str
    points: int
    cells: list[str]


class Exported(msgspec.Struct):
    """The files written by an export."""

    files: list[File]


class Field(msgspec.Struct):
    """A field of a cloud; ``xyz`` stands for x, y and z."""

    name: str
    dtype: Annotated[str, msgspec.Meta(description="as numpy writes it")]
    count: Annotated[int, msgspec.Meta(description="values per point")]
    unit: str


class Bounds(msgspec.Struct):
    """Bounds of all finite points."""

    min: list[float]
    max: list[float]

    @classmethod
    def of(cls, found: CloudDescription) -> Bounds | None:
        """Return the JSON form of a file's bounds; None without a finite point."""
        lowest, highest = (bound.tolist() for bound in found.bounds)
        return cls(lowest, highest) if all(map(math.isfinite, lowest)) else None


class Crs(msgspec.Struct):
    """The coordinate system that a file names."""

    name: str
    epsg: Annotated[int, msgspec.Meta(description="0: not said")]
    geographic: Annotated[bool, msgspec.Meta(description="x and y are degrees")]
    unit_m: Annotated[list[float], msgspec.Meta(description="metres per unit of x and y, of z")]
    units: list[str]


class CloudFile(msgspec.Struct):
    """A file of points."""

    path: str
    format: str
    encoding: Annotated[str, msgspec.Meta(description="of a PCD file")]
    version: str
    file_bytes: int
    points: Annotated[int, msgspec.Meta(description="in the file")]
    dropped: Annotated[
        int, msgspec.Meta(description="those of them that are left out: not finite, or flagged withheld")
    ]
    width: int
    height: int
    fields: list[Field]
    bounds: Bounds | None
    viewpoint: Annotated[list[float], msgspec.Meta(description="x, y, z, qw, qx, qy, qz")]
    warnings: list[str]
    crs: Crs | None

    @classmethod
    def of(cls, found: CloudDescription) -> CloudFile:
        """Return the JSON form of a file's description."""
        from shmmap.formats.coordinate_system import unit_warnings

        crs = found.crs
        return cls(
            found.path,
            found.format,
            found.encoding,
            found.version,
            found.file_bytes,
            found.points,
            found.dropped,
            found.width,
            found.height,
            [
                Field(
                    spec.name,
                    spec.dtype.str,
                    spec.components,
                    "" if spec.name == "xyz" and unit_warnings(crs) else spec.unit,
                )
                for spec in found.columns
            ],
            Bounds.of(found),
            list(found.viewpoint),
            list(found.warnings),
            None
            if crs is None
            else Crs(
                crs.name,
                crs.epsg,
                crs.geographic,
                [unit.metres for unit in crs.units],
                [unit.name for unit in crs.units],
            ),
        )


class UnreadFile(msgspec.Struct):
    """A file that cannot be read, and the reason."""

    path: str
    message: str


class Outside(msgspec.Struct):
    """A cell with points outside its box."""

    path: str
    box: Box


class ServedMap(msgspec.Struct):
    """A directory, described as a divided map."""

    cells: int
    outside_box: list[Outside]
    far: Annotated[list[str], msgspec.Meta(description="on cells far from all others")]
    origin: Annotated[
        Point, msgspec.Meta(description="to add for the coordinates of the clouds it was divided from")
    ] = (0.0, 0.0, 0.0)
    crs: str = ""
    unit_m: tuple[float, float] = (1.0, 1.0)
    problems: list[str] = []


class Directory(msgspec.Struct):
    """A directory of clouds: totals, and bounds of all points."""

    path: str
    files: list[CloudFile]
    failed: list[UnreadFile]
    points: int
    dropped: int
    file_bytes: int
    bounds: Bounds | None
    map: Annotated[ServedMap | None, msgspec.Meta(description="null where it is no divided map")]

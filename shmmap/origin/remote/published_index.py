# SPDX-License-Identifier: Apache-2.0
"""Index of a published map's cells and their objects: a root, and shards of neighbouring cells.

Both are columns in a MessagePack map in a zstd frame.  The root has one row for each shard and is small;
a shard is read when an area needs it.  ``ORIGIN.md`` specifies both byte by byte.
"""

from __future__ import annotations

import itertools
import math
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from hashlib import sha256
from typing import Any, Final, TypeAlias, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray
from xxhash import xxh3_64_intdigest

from shmmap.errors import MapDataError
from shmmap.origin.remote.published_object import (
    MAX_OBJECT_BYTES,
    POINTS,
    STAMP_BYTES,
    CellIdentity,
    ObjectName,
)
from shmmap.origin.remote.zstd_frame import DAMAGED, unpack_frame
from shmmap.segment.version import cell_version

MAX_ROOT_BYTES: Final = 16 << 20
MAX_SHARD_BYTES: Final = 4 << 20
FORMAT: Final = "shmmap published map"
READER: Final = 1
"""Version of this reader; a root that needs a later reader is refused."""
EXACT: Final = "exact"
MILLIMETRES: Final = "mm"
ENCODINGS: Final = (EXACT, MILLIMETRES)
"""Encodings of published points; in a map in millimetres, some cells may still be exact."""

MAX_LAYERS: Final = 64
_MAX_SPEC_CHARACTERS: Final = 200
_MAX_TEXT_CHARACTERS: Final = 4096
MAX_METRES: Final = 1e12
"""Coordinates and lengths are at most this far: sums and products of them are finite, and differences too."""
_UNITS_M: Final = (1e-9, 1e9)
_ROUNDING: Final = 2.0**-22  # twice the relative distance by which rounding to float32 may move a border
_SMALLEST_OBJECT_BYTES: Final = 4096

Box: TypeAlias = tuple[float, float, float, float]
_Struct = TypeVar("_Struct", bound=msgspec.Struct)


class _Head(msgspec.Struct, frozen=True):
    """The fields that show whether the rest of a root can be read."""

    format: str
    min_reader: int
    encoding: str


class RootFields(msgspec.Struct, frozen=True):
    """The MessagePack map of a root, in this order of keys."""

    format: str
    min_reader: int
    id_prefix: str
    frame_id: str
    crs: str
    origin: tuple[float, float, float]
    unit_m: tuple[float, float]
    encoding: str
    cells: int
    bounds: Box
    shard_m: float
    largest_m: tuple[float, float]
    mean_m: tuple[float, float]
    layers: dict[str, int]
    shard_keys: bytes
    shard_cells: bytes
    shard_bytes: bytes
    shard_sha256: bytes


class LayerFields(msgspec.Struct, frozen=True):
    """The columns of one layer in a shard."""

    size: bytes
    raw_size: bytes
    sha256: bytes
    content_sha256: bytes


class ShardFields(msgspec.Struct, frozen=True):
    """The MessagePack map of a shard, in this order of keys."""

    names: bytes
    boxes: bytes
    z: bytes
    points: bytes
    layers: dict[str, LayerFields]


# created at import: msgspec crashes the process if two threads decode a type for the first time at once
_HEAD: Final = msgspec.msgpack.Decoder(_Head)
_ROOT: Final = msgspec.msgpack.Decoder(RootFields)
_SHARD: Final = msgspec.msgpack.Decoder(ShardFields)


# --- columns ------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class ShardTable:
    """Layers and shards of a root, or of a part of one.

    Attributes
    ----------
    layers
        Builder version of each layer by spec.
    keys
        (S, 2) int32, row and column of each shard, ascending.
    counts, sizes
        (S,) uint32, number of cells of each shard, and bytes of its object.
    hashes
        (S, 32) uint8, SHA-256 of each shard's object, its name.
    """

    layers: Mapping[str, int]
    keys: NDArray[np.int32]
    counts: NDArray[np.uint32]
    sizes: NDArray[np.uint32]
    hashes: NDArray[np.uint8]


_Columns: TypeAlias = Mapping[str, tuple[str, str, int]]
"""For each attribute of an object: its field in the document, dtype, and numbers per row."""

_SHARD_COLUMNS: Final[_Columns] = {
    "keys": ("shard_keys", "<i4", 2),
    "counts": ("shard_cells", "<u4", 1),
    "sizes": ("shard_bytes", "<u4", 1),
    "hashes": ("shard_sha256", "u1", 32),
}
_LAYER_COLUMNS: Final[_Columns] = {
    "sizes": ("size", "<u4", 1),
    "raws": ("raw_size", "<u4", 1),
    "hashes": ("sha256", "u1", 32),
    "contents": ("content_sha256", "u1", 32),
}


class Damage:
    """Creates errors that name one damaged object."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __call__(self, message: str) -> MapDataError:
        """Return the error with this message."""
        return MapDataError(message, path=self._name, cause=DAMAGED)


def decode_map(unpacked: bytes, decoder: msgspec.msgpack.Decoder[_Struct], wrong: Damage) -> _Struct:
    """Decode the unpacked content of a frame; raise the error that ``wrong`` creates if it is malformed."""
    try:
        found: _Struct = decoder.decode(unpacked)
        return found
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise wrong(f"no MessagePack map of its kind: {error}") from None


def pack_fields(described: ShardTable, kind: type[msgspec.Struct]) -> dict[str, Any]:
    """Return the fields of a document of type ``kind`` for a root, or a part of one."""
    fields = {name: getattr(described, name) for name in kind.__struct_fields__ if hasattr(described, name)}
    layers = dict(sorted(described.layers.items()))
    return {**fields, "layers": layers, **_pack_columns(described, _SHARD_COLUMNS)}


def unpack_fields(found: msgspec.Struct, wrong: Damage) -> dict[str, Any]:
    """Return the attributes of the root, or the part of one, that a document describes."""
    fields = msgspec.structs.asdict(found)
    del fields["format"], fields["min_reader"]
    columns = _unpack_columns(found, _SHARD_COLUMNS, len(fields["shard_cells"]) // 4, wrong)
    for field, _, _ in _SHARD_COLUMNS.values():
        del fields[field]
    return {**fields, **columns}


def _pack_columns(described: object, columns: _Columns) -> dict[str, bytes]:
    return {
        field: _pack_column(getattr(described, name), dtype) for name, (field, dtype, _) in columns.items()
    }


def _unpack_columns(found: object, columns: _Columns, count: int, wrong: Damage) -> dict[str, NDArray[Any]]:
    return {
        name: _unpack_column(getattr(found, field), dtype, count, width, wrong)
        for name, (field, dtype, width) in columns.items()
    }


def _pack_column(column: NDArray[Any], dtype: str) -> bytes:
    """Return the bytes of a column, row by row."""
    return np.ascontiguousarray(column, np.dtype(dtype)).tobytes()


def _unpack_column(data: bytes, dtype: str, count: int, width: int, wrong: Damage) -> NDArray[Any]:
    """Read a column of ``count`` rows of ``width`` numbers."""
    kind = np.dtype(dtype)
    if len(data) != count * width * kind.itemsize:
        raise wrong("its columns are not of one length")
    column: NDArray[Any] = np.frombuffer(data, kind)
    return column.reshape(-1, width) if width > 1 else column


# --- the root -----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Root(ShardTable):
    """Root of one version of a published map; its layers ascend, and `POINTS` is one of them.

    Attributes
    ----------
    id_prefix
        Directory that all ids begin with; begins and ends with ``/``.
    crs, origin, unit_m
        Position of the map frame, see `shmmap.origin.map_report.MapFrame`.
    encoding
        One of `ENCODINGS`.
    bounds
        Box around all cells, metres, map frame.
    shard_m
        Side of a shard, metres.
    largest_m, mean_m
        Largest and mean extent of the cells along x and y, metres.
    map_version
        Map version of this root's content.
    """

    id_prefix: str
    frame_id: str
    crs: str
    origin: tuple[float, float, float]
    unit_m: tuple[float, float]
    encoding: str
    cells: int
    bounds: Box
    shard_m: float
    largest_m: tuple[float, float]
    mean_m: tuple[float, float]
    map_version: int = 0

    @property
    def first_indices(self) -> NDArray[np.int64]:
        """(S + 1,) index of each shard's first cell; the last entry is the number of cells."""
        return np.concatenate([[0], np.cumsum(self.counts, dtype=np.int64)])

    def shard_sha256(self, shard: int) -> bytes:
        """Return the SHA-256 of a shard's object, which is the object's name."""
        return bytes(self.hashes[shard].tobytes())

    def shards_near(self, bounds: Box) -> NDArray[np.intp]:
        """Return the shards that may have cells touching a rectangle, ascending.

        ``bounds`` is (min x, min y, max x, max y) in metres.  A cell belongs to the shard of its lower
        corner, so the result includes shards below and left of the rectangle.
        """
        min_x, min_y, max_x, max_y = bounds
        slack = _ROUNDING * max(map(abs, (*bounds, *self.bounds)))
        if not math.isfinite(slack):
            slack = 0.0
        columns = self._span(min_x - self.largest_m[0] - slack, max_x + slack, self.keys[:, 1])
        rows = self._span(min_y - self.largest_m[1] - slack, max_y + slack, self.keys[:, 0])
        return np.flatnonzero(rows & columns)

    def _span(self, low: float, high: float, keys: NDArray[np.int32]) -> NDArray[np.bool_]:
        within: NDArray[np.bool_] = (keys >= np.floor(low / self.shard_m)) & (
            keys <= np.floor(high / self.shard_m)
        )
        return within


def pack_root(root: Root) -> bytes:
    """Return the unpacked content of a root's frame."""
    fields = RootFields(format=FORMAT, min_reader=READER, **pack_fields(root, RootFields))
    return msgspec.msgpack.encode(fields)


def map_version_of(unpacked: bytes) -> int:
    """Return the map version of a root's unpacked content: its 16 hex digits are the first of the SHA-256."""
    return int.from_bytes(sha256(unpacked).digest()[:8], "big")


def unpack_root(frame: bytes | memoryview, *, name: str = "root") -> Root:
    """Read and check a root's object.

    Raises
    ------
    MapDataError
        The object is not a valid root (cause ``damaged``), or needs a later reader (``newer``).
    """
    unpacked = unpack_frame(frame, MAX_ROOT_BYTES, name=name)
    wrong = Damage(name)
    head = decode_map(unpacked, _HEAD, wrong)
    if head.format != FORMAT:
        raise wrong(f"its format is {head.format[:40]!r}, not {FORMAT!r}")
    if head.min_reader > READER or head.encoding not in ENCODINGS:
        raise MapDataError(
            f"it needs reader {head.min_reader} and encoding {head.encoding[:40]!r};"
            f" this is reader {READER}, for {' and '.join(ENCODINGS)}",
            path=name,
            cause="newer",
            hint="update shmmap",
        )
    found = decode_map(unpacked, _ROOT, wrong)
    texts = (found.id_prefix, found.frame_id, found.crs)
    if any(len(text) > _MAX_TEXT_CHARACTERS or "\0" in text for text in texts):
        raise wrong("a text is too long")
    if not is_id_prefix(found.id_prefix):
        raise wrong(f"{found.id_prefix!r} cannot begin ids")
    numbers = (*found.origin, *found.unit_m, *found.bounds, found.shard_m, *found.largest_m, *found.mean_m)
    if not all(map(math.isfinite, numbers)) or not _is_rectangle(found.bounds):
        raise wrong("a number is not finite, or the bounds are no rectangle")
    if found.shard_m <= 0 or min(*found.unit_m) <= 0 or min(*found.largest_m, *found.mean_m) < 0:
        raise wrong("a length is not positive")
    lengths = (*found.origin, *found.bounds, found.shard_m, *found.largest_m, *found.mean_m)
    if (
        max(map(abs, lengths)) > MAX_METRES
        or not _UNITS_M[0] <= min(found.unit_m) <= max(found.unit_m) <= _UNITS_M[1]
    ):
        raise wrong(f"a coordinate, a length or a unit is out of range ({MAX_METRES:g} m)")
    if POINTS not in found.layers:
        raise wrong("its layers have no points")
    check_layers(found.layers, wrong)
    root = Root(**unpack_fields(found, wrong), map_version=map_version_of(unpacked))
    if not len(root.counts):
        raise wrong("it has no shard")
    check_shards(root.keys, root.sizes, wrong)
    if int(root.counts.sum(dtype=np.uint64)) != root.cells or not root.counts.all():
        raise wrong(f"its shards do not have {root.cells:,} cells")
    return root


def check_layers(layers: Mapping[str, int], wrong: Damage) -> None:
    """Refuse layers that are not specs with their builder versions."""
    if len(layers) > MAX_LAYERS:
        raise wrong("its layers are too many")
    if any(len(spec) > _MAX_SPEC_CHARACTERS or not 0 <= built < 1 << 32 for spec, built in layers.items()):
        raise wrong("a layer is no spec with its builder version")


def check_shards(keys: NDArray[np.int32], sizes: NDArray[np.uint32], wrong: Damage) -> None:
    """Refuse shards that do not ascend, or whose objects are empty or too large."""
    order = (keys[:, 0].astype(np.int64) << 32) + keys[:, 1]
    if (np.diff(order) <= 0).any():
        raise wrong("its shards do not ascend")
    if not sizes.all() or int(sizes.max(initial=0)) > MAX_SHARD_BYTES:
        raise wrong(f"a shard is empty, or larger than {MAX_SHARD_BYTES:,} bytes")


def is_id_prefix(text: str) -> bool:
    """Whether a text may be an id prefix: an absolute path that ends with ``/``."""
    return text.startswith("/") and text.endswith("/") and "\0" not in text


# --- shards -------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class LayerObjects:
    """The objects of one layer, a row for each cell of a shard.

    ``sizes`` and ``raws``, (N,) uint32, are the bytes of each object and of its unpacked content; ``hashes``
    and ``contents``, (N, 32) uint8, are the SHA-256 of the two.
    """

    sizes: NDArray[np.uint32]
    raws: NDArray[np.uint32]
    hashes: NDArray[np.uint8]
    contents: NDArray[np.uint8]

    def objects(self) -> Iterator[tuple[bytes, int]]:
        """Yield hash and size of each object."""
        hashes = self.hashes.tobytes()
        return ((hashes[32 * row : 32 * row + 32], size) for row, size in enumerate(self.sizes.tolist()))

    def name(self, row: int) -> ObjectName:
        """Return the name of a cell's object."""
        return ObjectName(
            self.hashes[row].tobytes(),
            int(self.sizes[row]),
            int(self.raws[row]),
            self.contents[row].tobytes(),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Shard:
    """Neighbouring cells of a published map: a row for each, names ascending by their bytes.

    Attributes
    ----------
    names
        The rest of each cell's id after the map's `id_prefix`, UTF-8.
    boxes
        (N, 4) float64, ``min_x, min_y, max_x, max_y``, metres, map frame.
    z
        (N, 2) float64, lowest and highest z of the points, metres; NaN where there are none.
    points
        (N,) uint32, rows of layer ``points``.
    layers
        Objects of each layer by spec.
    """

    names: tuple[bytes, ...]
    boxes: NDArray[np.float64]
    z: NDArray[np.float64]
    points: NDArray[np.uint32]
    layers: Mapping[str, LayerObjects]

    def __len__(self) -> int:
        return len(self.names)

    def id(self, row: int, id_prefix: str) -> str:
        """Return the id of a cell."""
        return id_prefix + self.names[row].decode()

    def box(self, row: int) -> Box:
        """Return ``min_x, min_y, max_x, max_y`` of a cell, metres, map frame."""
        min_x, min_y, max_x, max_y = self.boxes[row].tolist()
        return min_x, min_y, max_x, max_y

    def stamp(self, row: int) -> bytes:
        """Return a cell's stamp: the first 24 bytes of its points' content digest."""
        return self.layers[POINTS].contents[row, :STAMP_BYTES].tobytes()

    def version(self, row: int, id_prefix: str) -> int:
        """Return the version of a cell."""
        return cell_version(self.id(row, id_prefix), self.stamp(row), self.box(row))

    def identity(self, row: int, root: Root) -> CellIdentity:
        """Return a cell's identity for `shmmap.origin.remote.published_object.write_segment`."""
        return CellIdentity(self.id(row, root.id_prefix), self.box(row), root.frame_id, self.stamp(row))


def published_layer_version(cell: int, layer: str, builder_version: int, content: bytes) -> int:
    """Return the version of a published layer other than ``points``.

    Parameters
    ----------
    cell
        Version of the cell.
    layer, builder_version
        Spec of the layer, and version of the builder that built it.
    content
        Content digest of the layer's object, 32 bytes.
    """
    spec = layer.encode()
    return xxh3_64_intdigest(
        struct.pack("<QI", cell, len(spec)) + spec + struct.pack("<I", builder_version) + content
    )


def pack_shard(shard: Shard) -> bytes:
    """Return the unpacked content of a shard's frame."""
    return msgspec.msgpack.encode(
        ShardFields(
            names=b"\0".join(shard.names),
            boxes=_pack_column(shard.boxes, "<f8"),
            z=_pack_column(shard.z, "<f8"),
            points=_pack_column(shard.points, "<u4"),
            layers={
                spec: LayerFields(**_pack_columns(layer, _LAYER_COLUMNS))
                for spec, layer in sorted(shard.layers.items())
            },
        )
    )


def unpack_shard(frame: bytes | memoryview, root: Root, number: int) -> Shard:
    """Verify and read the object of a root's shard.

    Raises
    ------
    MapDataError
        The frame does not match the root's hash, or is not a valid shard of this root (cause ``damaged``).
    """
    name = f"shard {root.keys[number].tolist()}"
    wrong = Damage(name)
    if sha256(frame).digest() != root.shard_sha256(number):
        raise wrong("its SHA-256 is not its name")
    unpacked = unpack_frame(frame, MAX_SHARD_BYTES, name=name)
    found = decode_map(unpacked, _SHARD, wrong)
    count = int(root.counts[number])
    names = tuple(found.names.split(b"\0"))
    if len(names) != count or any(not is_relative_path(one) for one in names):
        raise wrong(f"its names are not those of {count:,} files below the map")
    if any(first >= second for first, second in itertools.pairwise(names)):
        raise wrong("its names do not ascend")
    if set(found.layers) != set(root.layers):
        raise wrong("its layers are not the root's")
    shard = Shard(
        names=names,
        boxes=_unpack_column(found.boxes, "<f8", count, 4, wrong),
        z=_unpack_column(found.z, "<f8", count, 2, wrong),
        points=_unpack_column(found.points, "<u4", count, 1, wrong),
        layers={
            spec: LayerObjects(**_unpack_columns(layer, _LAYER_COLUMNS, count, wrong))
            for spec, layer in found.layers.items()
        },
    )
    low, high = shard.boxes[:, :2], shard.boxes[:, 2:]
    if not (np.abs(shard.boxes) <= MAX_METRES).all() or (low > high).any():
        raise wrong("a box is no rectangle, or out of range")
    if (high - low > np.array(root.largest_m)).any():
        raise wrong("a cell is larger than the root's largest")
    if (shard_keys(shard.boxes, root.shard_m) != root.keys[number]).any():
        raise wrong("a cell lies in another shard")
    has_points = shard.points > 0
    if (
        not (np.abs(shard.z[has_points]) <= MAX_METRES).all()
        or (shard.z[has_points, 0] > shard.z[has_points, 1]).any()
    ):
        raise wrong("a cell's lowest point is above its highest, or out of range")
    for layer in shard.layers.values():
        raws = layer.raws.astype(np.int64)
        if (raws < _SMALLEST_OBJECT_BYTES).any() or (raws > MAX_OBJECT_BYTES).any():
            raise wrong("the size of an object is out of range")
        # zstd's upper bound of the compressed size
        if (layer.sizes == 0).any() or (layer.sizes > raws + (raws >> 8) + 4096).any():
            raise wrong("the size of an object is out of range")
    return shard


def shard_keys(boxes: NDArray[np.float64], shard_m: float) -> NDArray[np.float64]:
    """Return (N, 2) row and column of each cell's shard, whole numbers: the shard of its lower corner."""
    keys: NDArray[np.float64] = np.floor(boxes[:, 1::-1] / shard_m)
    return keys


def is_relative_path(name: bytes) -> bool:
    """Whether a name is a UTF-8 path that stays below its directory."""
    try:
        name.decode()
    except UnicodeDecodeError:
        return False
    return all(part not in (b"", b".", b"..") for part in name.split(b"/"))


def _is_rectangle(box: Box) -> bool:
    return box[0] <= box[2] and box[1] <= box[3]

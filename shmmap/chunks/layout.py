# SPDX-License-Identifier: Apache-2.0
"""A chunk in shared memory: one header page, then its bricks.  ``CHUNKS.md`` is the byte-exact specification.

The first part of the header identifies the chunk, never changes, and has a checksum.  The rest changes with
every scan.  A read of it and of the bricks is consistent if ``sequence`` was even and the same before and
after the read.  Bricks are stored in the order in which they were first touched; the brick index at the end
of the header has their positions.  A chunk grows until it is evicted, and is then truncated to nothing.
"""

from __future__ import annotations

import struct
import zlib
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from shmmap.chunks.voxels import BRICK_VOXELS, BRICKS, CHUNK_SIDE, ChunkKey
from shmmap.errors import SegmentCorrupt

if TYPE_CHECKING:
    from numpy.typing import NDArray

CHUNKS_VERSION: Final = (2, 0)
MAJORS_READ: Final = (1, 2)
"""Readable major versions, with the same layout; a daemon of version 1 did not truncate evicted chunks."""
HEADER_BYTES: Final = 4096
BRICK_BYTES: Final = 2 * BRICK_VOXELS
MAX_BYTES: Final = HEADER_BYTES + BRICKS * BRICK_BYTES
MAPPERS: Final = 32
"""Number of mappers whose last scan a chunk remembers."""
OUT_OF_SERVICE: Final = 1
"""Value of ``state`` (0: in service) of a chunk that no longer changes; a new chunk may have its key."""

MAGIC: Final = b"SHMCHUNK"
BYTE_ORDER: Final = 0x01020304
MAX_FRAME_BYTES: Final = 40

_CONSTANT: Final = struct.Struct("<8sHHI16s3iId4hQ8x40s")
_CRC: Final = struct.Struct("<II")
STATE_AT: Final = 128
MAPPERS_AT: Final = 256
INDEX_AT: Final = 2048

STATE: Final = np.dtype(
    {
        "names": [
            "sequence",
            "version",
            "saved_version",
            "state",
            "bricks",
            "active",
            "occupied",
            "free",
            "changed_ns",
            "mappers",
        ],
        "formats": [
            "<u8",
            "<u8",
            "<u8",
            "<u4",
            "<u4",
            "<u4",
            "<u4",
            "<u4",
            "<u8",
            ([("number", "<u4"), ("reserved", "<u4"), ("scan", "<u8")], (MAPPERS,)),
        ],
        "offsets": [0, 8, 16, 24, 28, 32, 36, 40, 48, 128],
        "itemsize": 640,
    }
)
"""The part of the header that changes, from byte 128 on."""


class ChunkIdentity(msgspec.Struct, frozen=True):
    """The constant properties of a chunk.

    Attributes
    ----------
    map_id
        Id of the map, 16 bytes, chosen when the map was created.
    key
        Key of the chunk in the map.
    resolution
        Edge of a voxel, metres.
    clamp_min, clamp_max, occupied_above, free_below
        Log-odds in thousandths: bounds of all voxels, and the thresholds of occupied and free voxels.
    generation
        Increases each time that this map's worker loads a chunk into memory: the same key with an older
        generation is another chunk.
    frame_id
        Frame of the map, at most 40 bytes of UTF-8.
    """

    map_id: bytes
    key: ChunkKey
    resolution: float
    clamp_min: int
    clamp_max: int
    occupied_above: int
    free_below: int
    generation: int
    frame_id: str


def new_header(identity: ChunkIdentity) -> bytearray:
    """Return the header of an empty chunk.

    Raises
    ------
    ValueError
        The frame's name is longer than 40 bytes, or the map's id is not 16 bytes.
    """
    frame = identity.frame_id.encode()
    if len(frame) > MAX_FRAME_BYTES or len(identity.map_id) != 16:
        raise ValueError(f"frame {identity.frame_id!r} or map number does not fit a chunk's header")
    page = bytearray(HEADER_BYTES)
    _CONSTANT.pack_into(
        page,
        0,
        MAGIC,
        *CHUNKS_VERSION,
        BYTE_ORDER,
        identity.map_id,
        *identity.key,
        CHUNK_SIDE,
        identity.resolution,
        identity.clamp_min,
        identity.clamp_max,
        identity.occupied_above,
        identity.free_below,
        identity.generation,
        frame,
    )
    _CRC.pack_into(page, _CONSTANT.size, zlib.crc32(page[: _CONSTANT.size]), 0)
    return page


def read_identity(page: bytes | bytearray | memoryview, name: str = "chunk") -> ChunkIdentity:
    """Read the part of a header that does not change.

    Parameters
    ----------
    page
        At least the first 128 bytes.
    name
        Name in error messages.

    Raises
    ------
    SegmentCorrupt
        The page is not the header of a chunk, has another major version, or has a wrong checksum.
    """
    if len(page) < STATE_AT:
        raise SegmentCorrupt(f"{name}: {len(page)} bytes are too few for the header of a chunk")
    (
        magic,
        major,
        minor,
        order,
        map_id,
        x,
        y,
        z,
        side,
        resolution,
        clamp_min,
        clamp_max,
        occupied_above,
        free_below,
        generation,
        frame,
    ) = _CONSTANT.unpack_from(page)
    if magic != MAGIC:
        raise SegmentCorrupt(f"{name}: no chunk: it starts with {magic!r}")
    if order != BYTE_ORDER:
        raise SegmentCorrupt(f"{name}: written on a machine of other byte order")
    if major not in MAJORS_READ:
        raise SegmentCorrupt(
            f"{name}: version {major}.{minor} of the layout, this reads {CHUNKS_VERSION[0]}",
            hint="update whichever of writer and reader is older",
        )
    if _CRC.unpack_from(page, _CONSTANT.size)[0] != zlib.crc32(bytes(page[: _CONSTANT.size])):
        raise SegmentCorrupt(f"{name}: the header's checksum is wrong")
    key = ChunkKey(x, y, z)
    if side != CHUNK_SIDE or not key.possible or not (0.0 < resolution < float("inf")):
        raise SegmentCorrupt(
            f"{name}: there is no chunk {key.text} of {side} voxels a side, {resolution} m each"
        )
    try:
        frame_id = frame.split(b"\0")[0].decode()
    except UnicodeDecodeError as error:
        raise SegmentCorrupt(f"{name}: its frame's name is no UTF-8") from error
    return ChunkIdentity(
        map_id, key, resolution, clamp_min, clamp_max, occupied_above, free_below, generation, frame_id
    )


def chunk_bytes(bricks: int) -> int:
    """Return the length of a chunk with this many bricks, bytes."""
    return HEADER_BYTES + bricks * BRICK_BYTES


class ChunkView:
    """Arrays over the bytes of a chunk, its whole header at least.

    Attributes
    ----------
    state
        The changing part of the header, fields as in `STATE`: a zero-dimensional structured array.
    index
        (1024,) uint16: position of each brick, 0 for none, n for the n-th after the header.
    bricks
        (N, 256) int16: log-odds in thousandths, bricks in storage order; N is as many as fit into the bytes.
    """

    def __init__(self, data: Any) -> None:
        self.data = memoryview(data).cast("B")
        self.state: NDArray[Any] = np.ndarray((), STATE, self.data, STATE_AT)
        self.index: NDArray[np.uint16] = np.ndarray((BRICKS,), "<u2", self.data, INDEX_AT)
        count = min(BRICKS, (len(self.data) - HEADER_BYTES) // BRICK_BYTES)
        self.bricks: NDArray[np.int16] = np.ndarray((count, BRICK_VOXELS), "<i2", self.data, HEADER_BYTES)

    @property
    def identity(self) -> ChunkIdentity:
        """Identity of the chunk; raises as `read_identity`."""
        return read_identity(self.data[:STATE_AT])

    def at(self, places: NDArray[np.integer]) -> NDArray[np.int16]:
        """Return voxels by their places in the chunk, (N,); 0 for unknown voxels."""
        numbers = self.index[places >> 8].astype(np.intp)  # of bricks, which have 256 voxels
        found = np.zeros(len(numbers), np.int16)
        known = np.flatnonzero(numbers)
        found[known] = self.bricks[numbers[known] - 1, places[known] & 255]
        return found

    def dense(self) -> NDArray[np.int16]:
        """Return all voxels by their place in the chunk, (262144,); 0 for unknown voxels."""
        full = np.zeros((BRICKS, BRICK_VOXELS), np.int16)
        there = np.flatnonzero(self.index)
        full[there] = self.bricks[self.index[there].astype(np.intp) - 1]
        return full.reshape(-1)


def check_consistent(view: ChunkView, name: str = "chunk") -> None:
    """Check that index, bricks and counters of a chunk agree while it is not being written.

    Raises
    ------
    SegmentCorrupt
        They contradict each other, or a voxel lies beyond the clamps.
    """
    identity, state = view.identity, view.state
    count = int(state["bricks"])
    there = view.index[view.index != 0]
    if count > len(view.bricks) or len(there) != count or len(np.unique(there)) != count:
        raise SegmentCorrupt(f"{name}: the brick index does not fit {count} bricks")
    if count and int(there.max()) != count:
        raise SegmentCorrupt(f"{name}: the brick index names brick {int(there.max())} of {count}")
    cells = view.bricks[:count]
    if count and not (identity.clamp_min <= int(cells.min()) and int(cells.max()) <= identity.clamp_max):
        raise SegmentCorrupt(f"{name}: a voxel lies beyond the clamps")
    counted = {
        "active": np.count_nonzero(cells),
        "occupied": np.count_nonzero(cells > identity.occupied_above),
        "free": np.count_nonzero(cells < identity.free_below),
    }
    for what, number in counted.items():
        if int(state[what]) != number:
            raise SegmentCorrupt(f"{name}: {number} voxels are {what}, its header says {int(state[what])}")

# SPDX-License-Identifier: Apache-2.0
"""A chunk on disk: a header that identifies it, and its known voxels, compressed.  See ``CHUNKS.md``.

A file that is not exactly as written is refused: length and two checksums reveal truncation and changes,
counters reveal inconsistent content.
"""

from __future__ import annotations

import struct
import threading
import zlib
from typing import TYPE_CHECKING, Any, Final

import msgspec
from xxhash import xxh3_64_intdigest

from shmmap.chunks.layout import (
    BRICK_BYTES,
    INDEX_AT,
    MAPPERS,
    MAPPERS_AT,
    ChunkIdentity,
    ChunkView,
    check_consistent,
    chunk_bytes,
    new_header,
)
from shmmap.chunks.voxels import BRICKS, ChunkKey
from shmmap.errors import ConfigError, MapDataError, SegmentCorrupt
from shmmap.lazy_imports import needed_packages

if TYPE_CHECKING:
    from collections.abc import Callable

CHUNK_FILE_VERSION: Final = (1, 0)
CODECS: Final = {"raw": 0, "zstd": 1, "zlib": 2}
"""Compressions of a file's body, with their numbers in the header."""
FILE_HEADER_BYTES: Final = 128

_MAGIC: Final = b"SHMCHFIL"
_ORDER: Final = 0x01020304
_HEADER: Final = struct.Struct("<8sHHI16s3iIQQQQ4IQd8x")
_CRC: Final = struct.Struct("<II")
_MAPPERS_BYTES: Final = 16 * MAPPERS
_INDEX_BYTES: Final = 2 * BRICKS
_FIXED_BYTES: Final = _MAPPERS_BYTES + _INDEX_BYTES
_ZSTD_LEVEL: Final = 3
_ZLIB_LEVEL: Final = 1
_of_this_thread: Final = threading.local()
"""Compressor of each thread: creating one takes a fifth of the time for compressing a chunk."""


class ChunkFileHeader(msgspec.Struct, frozen=True):
    """Header of a chunk's file, which is read without the body.

    Attributes
    ----------
    map_id, key, resolution
        As in `ChunkIdentity`.
    codec
        Number of the compression, see `CODECS`.
    version, changed_ns
        Version of the saved chunk, and the time of its last change.
    active, occupied, free, bricks
        Numbers of known voxels, of occupied and free ones among them, and of their bricks.
    stored_bytes, body_hash
        Length of the body as it is stored, and its XXH3-64.
    """

    map_id: bytes
    key: ChunkKey
    resolution: float
    codec: int
    version: int
    changed_ns: int
    active: int
    occupied: int
    free: int
    bricks: int
    stored_bytes: int
    body_hash: int


def usual_codec() -> str:
    """Return ``zstd`` if its package is installed, else ``zlib``."""
    try:
        import zstandard  # noqa: F401
    except ModuleNotFoundError:
        return "zlib"
    return "zstd"


def _compressor(codec: int) -> Callable[[bytes], bytes]:
    if codec == CODECS["raw"]:
        return bytes
    if codec == CODECS["zlib"]:
        return lambda data: zlib.compress(data, _ZLIB_LEVEL)
    compressor: Any = getattr(_of_this_thread, "compressor", None)
    if compressor is None:
        with needed_packages("chunks compressed with zstd"):
            import zstandard
        compressor = _of_this_thread.compressor = zstandard.ZstdCompressor(level=_ZSTD_LEVEL)
    compress: Callable[[bytes], bytes] = compressor.compress
    return compress


def _decompress(codec: int, data: memoryview, expected: int) -> bytes:
    """Decompress data; return nothing if the length is not ``expected``, without exceeding that by much."""
    if codec == CODECS["raw"]:
        return bytes(data)
    if codec == CODECS["zlib"]:
        one = zlib.decompressobj()
        found = one.decompress(data, expected + 1)
        return found if one.eof and not one.unused_data else b""
    with needed_packages("chunks compressed with zstd"):
        import zstandard
    try:
        if zstandard.get_frame_parameters(data).content_size != expected:
            return b""
        return bytes(zstandard.ZstdDecompressor().decompress(data, allow_extra_data=False))
    except zstandard.ZstdError:
        return b""


def encode_chunk(view: ChunkView, codec: str = "zlib") -> bytes:
    """Return the file of a chunk that is not being changed: a copy, or called in the writer's thread.

    Raises
    ------
    ConfigError
        The codec is unknown.
    PackageMissing
        The codec's package is not installed.
    """
    number = CODECS.get(codec)
    if number is None:
        raise ConfigError(f"codec {codec!r}: there are {', '.join(CODECS)}", key="codec")
    identity, state = view.identity, view.state
    bricks = int(state["bricks"])
    data = view.data
    body = b"".join(
        (
            data[MAPPERS_AT : MAPPERS_AT + _MAPPERS_BYTES],
            data[INDEX_AT : INDEX_AT + _INDEX_BYTES],
            data[chunk_bytes(0) : chunk_bytes(bricks)],
        )
    )
    stored = _compressor(number)(body)
    header = _HEADER.pack(
        _MAGIC,
        *CHUNK_FILE_VERSION,
        _ORDER,
        identity.map_id,
        *identity.key,
        number,
        int(state["version"]),
        len(body),
        len(stored),
        xxh3_64_intdigest(stored),
        int(state["active"]),
        int(state["occupied"]),
        int(state["free"]),
        bricks,
        int(state["changed_ns"]),
        identity.resolution,
    )
    return b"".join((header, _CRC.pack(zlib.crc32(header), 0), stored))


def read_file_header(data: bytes | memoryview, path: str = "") -> ChunkFileHeader:
    """Read the first 128 bytes of a chunk's file.

    Raises
    ------
    MapDataError
        The bytes are not a header of a chunk's file, are of another major version, or were changed.
    """
    if len(data) < FILE_HEADER_BYTES:
        raise MapDataError(
            f"{len(data)} bytes are too few for the header of a chunk's file", path=path, cause="truncated"
        )
    (
        magic,
        major,
        minor,
        order,
        map_id,
        x,
        y,
        z,
        codec,
        version,
        raw,
        stored,
        body_hash,
        active,
        occupied,
        free,
        bricks,
        changed_ns,
        resolution,
    ) = _HEADER.unpack_from(data)
    if magic != _MAGIC or order != _ORDER:
        raise MapDataError("no chunk's file", path=path, offset=0)
    if major != CHUNK_FILE_VERSION[0]:
        raise MapDataError(
            f"version {major}.{minor} of the chunk file, this reads {CHUNK_FILE_VERSION[0]}",
            path=path,
            offset=8,
        )
    if _CRC.unpack_from(data, _HEADER.size) != (zlib.crc32(data[: _HEADER.size]), 0):
        raise MapDataError("the header's checksum is wrong", path=path, offset=_HEADER.size)
    if codec not in CODECS.values():
        raise MapDataError(f"codec {codec} is none that this reads", path=path, offset=44)
    key = ChunkKey(x, y, z)
    if not key.possible or bricks > BRICKS or raw != _FIXED_BYTES + bricks * BRICK_BYTES:
        raise MapDataError(
            f"there is no chunk {key.text} of {bricks} bricks, {raw} bytes", path=path, offset=32
        )
    return ChunkFileHeader(
        map_id, key, resolution, codec, version, changed_ns, active, occupied, free, bricks, stored, body_hash
    )


def check_file(data: bytes, path: str = "") -> ChunkFileHeader:
    """Check the length and the checksums of a whole file; return its header.

    Raises
    ------
    MapDataError
        The length or a checksum is wrong; or as `read_file_header`.
    """
    header = read_file_header(data, path)
    stored = memoryview(data)[FILE_HEADER_BYTES:]
    if len(stored) != header.stored_bytes:
        raise MapDataError(
            f"{len(stored)} bytes of body where there should be {header.stored_bytes}",
            path=path,
            offset=FILE_HEADER_BYTES,
            cause="truncated",
        )
    if xxh3_64_intdigest(stored) != header.body_hash:
        raise MapDataError("the body's checksum is wrong", path=path, offset=FILE_HEADER_BYTES)
    return header


def check_identity(header: ChunkFileHeader, identity: ChunkIdentity, path: str = "") -> None:
    """Check that a header is that of this chunk of this map.

    Raises
    ------
    MapDataError
        It is another chunk's, of another map, or of voxels of another size.
    """
    if (header.map_id, header.key) != (identity.map_id, identity.key):
        raise MapDataError(
            f"it is chunk {header.key.text} of map {header.map_id.hex()}, not {identity.key.text} of"
            f" {identity.map_id.hex()}",
            path=path,
            offset=16,
            cause="another_chunk",
        )
    if header.resolution != identity.resolution:
        raise MapDataError(
            f"its voxels are {header.resolution} m a side, not {identity.resolution} m", path=path, offset=104
        )


def decode_chunk(data: bytes, identity: ChunkIdentity, path: str = "") -> bytearray:
    """Return a saved chunk's bytes as they are in memory.

    Parameters
    ----------
    data
        The whole file.
    identity
        Expected identity of the chunk, with its new generation.
    path
        Name of the file in error messages.

    Raises
    ------
    MapDataError
        The file is not that of this chunk, or was truncated or changed.
    PackageMissing
        The package for its codec is not installed.
    """
    header = read_file_header(data, path)
    check_identity(header, identity, path)
    check_file(data, path)
    stored = memoryview(data)[FILE_HEADER_BYTES:]
    expected = _FIXED_BYTES + header.bricks * BRICK_BYTES
    try:
        body = _decompress(header.codec, stored, expected)
    except zlib.error:
        body = b""
    if len(body) != expected:
        raise MapDataError("the body cannot be decompressed", path=path, offset=FILE_HEADER_BYTES)
    return _in_memory(header, identity, body, path)


def _in_memory(header: ChunkFileHeader, identity: ChunkIdentity, body: bytes, path: str) -> bytearray:
    chunk = new_header(identity)
    chunk[MAPPERS_AT : MAPPERS_AT + _MAPPERS_BYTES] = body[:_MAPPERS_BYTES]
    chunk[INDEX_AT : INDEX_AT + _INDEX_BYTES] = body[_MAPPERS_BYTES:_FIXED_BYTES]
    chunk += body[_FIXED_BYTES:]
    view = ChunkView(chunk)
    said: dict[str, Any] = msgspec.structs.asdict(header)
    for name in ("version", "changed_ns", "active", "occupied", "free", "bricks"):
        view.state[name] = said[name]
    view.state["saved_version"] = header.version
    try:
        check_consistent(view, "the chunk")
    except SegmentCorrupt as error:
        raise MapDataError(error.message, path=path, offset=FILE_HEADER_BYTES) from error
    return chunk

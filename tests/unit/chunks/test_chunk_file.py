# SPDX-License-Identifier: Apache-2.0
"""A chunk comes back from disk as it was, or not at all."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable

import numpy as np
import pytest
from msgspec.structs import replace
from xxhash import xxh3_64_intdigest

from shmmap.chunks.chunk_file import (
    CODECS,
    decode_chunk,
    encode_chunk,
    read_file_header,
    usual_codec,
)
from shmmap.chunks.layout import ChunkIdentity, ChunkView, check_consistent
from shmmap.chunks.marking import Marker
from shmmap.chunks.occupancy import ScanFilter
from shmmap.chunks.voxels import ChunkKey
from shmmap.errors import ConfigError, MapDataError
from tests.support.chunk_memory import ChunkMemory

GOLDEN = (
    "53484d434846494c0100000004030201"  # SHMCHFIL, 1.0, byte order
    "000102030405060708090a0b0c0d0e0f"
    "ffffffff000000000000000000000000"  # chunk -1, 0, 0; not compressed
    "0100000000000000000c000000000000"  # version 1, body of 3072 bytes
    "000c000000000000"
)  # fmt: skip


def small_chunk() -> ChunkView:
    """One voxel hit and one passed through, by scan 9 of mapper 5."""
    memory, key = ChunkMemory(0.5), ChunkKey(-1, 0, 0)
    view = memory.writer.apply(
        memory.chunk(key), np.array([0, 1], np.uint16), np.array([1, 1], np.uint64), 1, mapper=5, scan=9,
        now_ns=77, grow=lambda bricks: memory.grown(key, bricks),
    )  # fmt: skip
    check_consistent(view)
    return view


def large_chunk() -> ChunkView:
    memory, marker = ChunkMemory(0.1), Marker(0.1, ScanFilter(0.0, 9.0, -9.0, 9.0))
    pose = np.eye(4)
    pose[:3, 3] = 3.0
    rng = np.random.default_rng(7)
    for number in range(1, 6):
        points = rng.uniform(-2.5, 2.5, (200, 3))
        memory.apply(marker.mark(points, pose)[0], mapper=number, scan=number, known=tuple(range(9)))
    (view,) = memory.chunks.values()
    return view


def again(view: ChunkView) -> ChunkIdentity:
    """The same chunk, brought into memory another time."""
    return replace(view.identity, generation=view.identity.generation + 1)


def test_golden_bytes() -> None:
    view = small_chunk()
    data = encode_chunk(view, "raw")
    assert data[:72].hex() == GOLDEN
    body = data[128:]
    assert struct.unpack_from("<Q4IQd", data, 72) == (xxh3_64_intdigest(body), 2, 1, 1, 1, 77, 0.5)
    assert data[112:128] == bytes(8) + struct.pack("<II", zlib.crc32(data[:120]), 0)
    assert len(body) == 2560 + 512
    assert struct.unpack_from("<IIQ", body) == (5, 0, 9)
    assert struct.unpack_from("<1024H", body, 512) == (1, *[0] * 1023)
    assert struct.unpack_from("<256h", body, 2560) == (847, *[0] * 63, -405, *[0] * 191)


@pytest.mark.parametrize("codec", list(CODECS))
@pytest.mark.parametrize("make", [small_chunk, large_chunk])
def test_there_and_back(codec: str, make: Callable[[], ChunkView]) -> None:
    view = make()
    data = encode_chunk(view, codec)
    header = read_file_header(data[:128])
    assert (header.key, header.codec, header.stored_bytes) == (
        view.identity.key,
        CODECS[codec],
        len(data) - 128,
    )
    loaded = ChunkView(decode_chunk(data, again(view)))
    assert loaded.identity == again(view)
    assert np.array_equal(loaded.dense(), view.dense())
    assert np.array_equal(loaded.state["mappers"], view.state["mappers"])
    for name in ("version", "active", "occupied", "free", "bricks", "changed_ns"):
        assert loaded.state[name] == view.state[name], name
    assert loaded.state["saved_version"] == view.state["version"]
    assert (int(loaded.state["sequence"]), int(loaded.state["state"])) == (0, 0)
    assert encode_chunk(loaded, codec) == data


def test_what_is_compressed_is_small() -> None:
    view = large_chunk()
    sizes = {codec: len(encode_chunk(view, codec)) for codec in CODECS}
    assert max(sizes["zstd"], sizes["zlib"]) < sizes["raw"] / 4


@pytest.mark.parametrize("codec", list(CODECS))
def test_every_file_that_was_cut_is_refused(codec: str) -> None:
    view = small_chunk()
    data = encode_chunk(view, codec)
    for size in range(len(data)):
        with pytest.raises(MapDataError):
            decode_chunk(data[:size], again(view))
    with pytest.raises(MapDataError):
        decode_chunk(data + b"\0", again(view))


@pytest.mark.parametrize("codec", list(CODECS))
def test_every_bit_that_flipped_is_noticed(codec: str) -> None:
    view = small_chunk()
    data = bytearray(encode_chunk(view, codec))
    for at in range(len(data)):
        for bit in range(8) if at < 160 else (at % 8,):
            data[at] ^= 1 << bit
            with pytest.raises(MapDataError) as caught:
                decode_chunk(bytes(data), again(view), "/maps/-1_0_0.chunk")
            assert str(caught.value).startswith("/maps/-1_0_0.chunk: ")
            data[at] ^= 1 << bit
    decode_chunk(bytes(data), again(view))


def forged(change: Callable[[bytearray], None]) -> bytes:
    """A file with both checksums right although something was changed."""
    data = bytearray(encode_chunk(small_chunk(), "raw"))
    change(data)
    struct.pack_into("<Q", data, 72, xxh3_64_intdigest(bytes(data[128:])))
    struct.pack_into("<I", data, 120, zlib.crc32(bytes(data[:120])))
    return bytes(data)


def put(at: int, form: str, *values: object) -> Callable[[bytearray], None]:
    return lambda data: struct.pack_into(form, data, at, *values)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (put(8, "<H", 2), r"version 2\.0"),
        (put(44, "<I", 3), "codec 3"),
        (put(44, "<I", 1), "cannot be decompressed"),
        (put(44, "<I", 2), "cannot be decompressed"),
        (put(32, "<i", 2**24), "no chunk 16777216_0_0"),
        (put(92, "<I", 2), "no chunk"),
        (put(56, "<Q", 2**40), "1099511627776 bytes"),
        (put(80, "<I", 3), "are active"),
        (put(84, "<I", 0), "are occupied"),
        (put(128 + 512, "<H", 2), "names brick 2"),
        (put(128 + 2560, "<h", 30_000), "beyond the clamps"),
        (put(16, "<B", 9), "it is chunk -1_0_0 of map 0901"),
        (put(32, "<i", 4), "it is chunk 4_0_0"),
        (put(104, "<d", 0.25), r"0\.25 m a side, not 0\.5 m"),
    ],
)
def test_a_file_that_contradicts_itself_is_refused(change: Callable[[bytearray], None], said: str) -> None:
    with pytest.raises(MapDataError, match=said):
        decode_chunk(forged(change), again(small_chunk()))


def test_a_body_that_would_be_too_long_is_not_made() -> None:
    """What says it is small and is not: as little is decompressed as it should have been."""
    import zstandard

    for codec, bomb in (
        ("zlib", zlib.compress(bytes(1 << 28))),
        ("zstd", zstandard.ZstdCompressor().compress(bytes(1 << 28))),
    ):
        data = bytearray(encode_chunk(small_chunk(), codec)[:128]) + bomb
        struct.pack_into("<QQ", data, 64, len(bomb), xxh3_64_intdigest(bomb))
        struct.pack_into("<I", data, 120, zlib.crc32(bytes(data[:120])))
        with pytest.raises(MapDataError, match="cannot be decompressed"):
            decode_chunk(bytes(data), again(small_chunk()))


def test_codecs() -> None:
    assert usual_codec() == "zstd"
    with pytest.raises(ConfigError, match="raw, zstd, zlib"):
        encode_chunk(small_chunk(), "lz4")

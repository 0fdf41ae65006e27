# SPDX-License-Identifier: Apache-2.0
"""The segment layout, byte by byte, against hex written down and a reader made from LAYOUT.md."""

from __future__ import annotations

import math
import struct
import zlib

import numpy as np
import pytest
from msgspec.structs import replace
from xxhash import xxh3_64_intdigest

from shmmap.columns import ColumnSpec
from shmmap.errors import SegmentCorrupt
from shmmap.segment.header import (
    PublishBlock,
    pack_header,
    pack_publish_block,
    unpack_header,
    unpack_publish_block,
)
from shmmap.segment.layout import Lattice, SegmentHeader, SourceStamp, header_size, plan_columns
from shmmap.segment.version import cell_version, layer_version
from tests.support.segment_reader import parse

# offset and bytes of everything that is not zero in the header below
GOLDEN = {
    0: "53484d4d415000010100030004030201",  # magic, 1.3, byte order
    16: "00100000000000008010000000000000",  # 4096 header bytes, 4224 total
    32: "02000000000000000300000000000000",  # 2 rows of 3 points
    48: "01000000000000002c01000000000000",  # 1 dropped, source of 300 bytes
    64: "15cd853dfe9c971715972079fe9c9717",  # mtime, ctime
    80: "000102030405060708090a0b0c0d0e0f",  # digest
    96: "00000000000034c00000000000000000",  # -20, 0
    112: "00000000000000000000000000003440",  # 0, 20
    128: "000000000000f8bf0000000000000240",  # z -1.5 .. 2.25
    160: "00000000000000000700000002000000",  # origin z, builder 7, 2 columns
    176: "00020000800000000003000008000000",  # table at 512, rows of 128; id at 768, 8 bytes
    192: "08030000060000000e03000003000000",  # layer, frame
    512: "78797a00000000000000000000000000",  # xyz
    544: "00000000000000003c66340000000000",  # <f4
    560: "6d000000000000000000000000000000",  # m
    576: "02000000000000000200000000000000",  # 2 dimensions: 2 x
    592: "03000000000000000000000000000000",  # 3
    608: "00000000000000000010000000000000",  # at 4096
    624: "18000000000000008877665544332211",  # 24 bytes, checksum
    640: "696e74656e7369747900000000000000",  # intensity
    672: "00000000000000007c75310000000000",  # |u1
    704: "01000000000000000200000000000000",  # 1 dimension: 2
    736: "00000000000000004010000000000000",  # at 4160
    752: "020000000000000000ffeeddccbbaa99",  # 2 bytes, checksum
    768: "2f6d2f612e706364706f696e74736d61",  # /m/a.pcd points ma
    784: "70000000000000000000000000000000",  # p
    4016: "0000000000000000e30a1bc700000000",  # CRC at 4024
}
GOLDEN_PUBLISH = "5055424c49534800 0807060504030201 1817161514131211" + "00" * 32 + "aecf54c3 00000000"


def golden_page() -> bytes:
    page = bytearray(4096)
    for offset, text in GOLDEN.items():
        page[offset : offset + 16] = bytes.fromhex(text)
    return bytes(page)


def golden_header() -> SegmentHeader:
    specs = [ColumnSpec("xyz", np.dtype("<f4"), 3, "m"), ColumnSpec("intensity", np.dtype("u1"))]
    header_bytes = header_size(2, "/m/a.pcd", "points", "map")
    columns, total = plan_columns(specs, 2, header_bytes)
    return SegmentHeader(
        cell_id="/m/a.pcd",
        layer="points",
        columns=(
            replace(columns[0], checksum=0x1122334455667788),
            replace(columns[1], checksum=0x99AABBCCDDEEFF00),
        ),
        rows=2,
        box=(-20.0, 0.0, 0.0, 20.0),
        header_bytes=header_bytes,
        total_bytes=total,
        z_min=-1.5,
        z_max=2.25,
        source_points=3,
        dropped_points=1,
        source=SourceStamp(300, 1700000000123456789, 1700000001123456789),
        source_digest=bytes(range(16)),
        builder_version=7,
    )


def resealed(page: bytearray) -> memoryview:
    """Give a changed header a right checksum."""
    end = len(page) - 72
    struct.pack_into("<I", page, end, zlib.crc32(page[:end]))
    return memoryview(bytes(page))


def test_packs_to_the_golden_bytes() -> None:
    assert pack_header(golden_header()) == golden_page()


def test_the_document_s_reader_reads_the_golden_bytes() -> None:
    points = np.array([[1, 2, 3], [4, 5, 6]], "<f4")
    body = points.tobytes() + bytes(40) + b"\x07\x09" + bytes(62)
    page = golden_page()[:-64] + bytes.fromhex(GOLDEN_PUBLISH)
    read = parse(page + body)
    assert read.fields == {
        "header_bytes": 4096, "total_bytes": 4224, "rows": 2, "source_points": 3, "dropped_points": 1,
        "source": (300, 1700000000123456789, 1700000001123456789), "digest": bytes(range(16)),
        "box": (-20.0, 0.0, 0.0, 20.0), "z": (-1.5, 2.25), "origin": (0.0, 0.0, 0.0),
        "builder_version": 7, "cell_id": "/m/a.pcd", "layer": "points", "frame_id": "map",
    }  # fmt: skip
    assert np.array_equal(read.columns["xyz"], points)
    assert read.columns["intensity"].tolist() == [7, 9]
    assert read.units == {"xyz": "m", "intensity": ""}
    assert (read.epoch, read.version) == (0x0102030405060708, 0x1112131415161718)


def test_publish_block_golden_bytes() -> None:
    block = PublishBlock(0x0102030405060708, 0x1112131415161718)
    assert pack_publish_block(block) == bytes.fromhex(GOLDEN_PUBLISH)
    page = memoryview(golden_page()[:-64] + bytes.fromhex(GOLDEN_PUBLISH))
    assert unpack_publish_block(page, 4096) == block
    assert unpack_publish_block(memoryview(golden_page()), 4096) is None


def test_the_publish_block_is_no_part_of_the_header_s_checksum() -> None:
    page = golden_page()[:-64] + bytes.fromhex(GOLDEN_PUBLISH)
    assert unpack_header(memoryview(page), 4224) == golden_header()


@pytest.mark.parametrize(
    ("offset", "form", "value"),
    [
        (8, "<H", 2),  # other major version
        (12, "<I", 0x04030201),  # other byte order
        (16, "<Q", 4097),  # header no whole number of pages
        (16, "<Q", 0),
        (16, "<Q", 2**63),
        (24, "<Q", 4225),  # more than there is
        (24, "<Q", 100),  # less than the header
        (172, "<I", 60),  # more columns than fit
        (172, "<I", 2**32 - 1),
        (176, "<I", 2**32 - 1),  # table outside
        (180, "<I", 64),  # rows too short
        (184, "<I", 5000),  # id outside
        (188, "<I", 2**32 - 1),
        (512 + 64, "<I", 5),  # dimensions
        (512 + 64, "<I", 2**32 - 1),
        (512 + 72, "<Q", 3),  # shape contradicts size
        (512 + 72, "<Q", 2**62),
        (512 + 104, "<Q", 0),  # column inside the header
        (512 + 104, "<Q", 4100),  # not aligned
        (512 + 104, "<Q", 4224),  # column after the end
        (512 + 104, "<Q", 2**64 - 64),
        (512 + 112, "<Q", 2**64 - 1),
        (512 + 40, "<4s", b">f4\0"),  # big-endian
        (512 + 40, "<4s", b"|O8\0"),  # objects
    ],
)
def test_a_well_sealed_lie_is_noticed(offset: int, form: str, value: int | bytes) -> None:
    page = bytearray(golden_page())
    struct.pack_into(form, page, offset, value)
    with pytest.raises(SegmentCorrupt):
        unpack_header(resealed(page), 4224)


def test_a_later_minor_version_with_longer_rows_is_read() -> None:
    page = bytearray(golden_page())
    second, texts = page[640:768], page[768 : 768 + 17]
    page[512 + 128 : 1024] = bytes(1024 - 640)
    page[512 + 192 : 512 + 192 + 128] = second
    page[900 : 900 + 17] = texts
    struct.pack_into("<H", page, 10, 9)
    struct.pack_into("<I", page, 180, 192)
    struct.pack_into("<6I", page, 184, 900, 8, 908, 6, 914, 3)
    assert unpack_header(resealed(page), 4224) == golden_header()


def test_many_columns_and_long_names_take_more_pages() -> None:
    specs = [ColumnSpec(f"column number {i}", np.dtype("<f8"), 1 + i % 3) for i in range(40)]
    cell_id = "/" + "ä" * 600
    header_bytes = header_size(len(specs), cell_id, "points", "map")
    assert header_bytes == 8192
    columns, total = plan_columns(specs, 5, header_bytes)
    header = SegmentHeader(cell_id, "points", columns, 5, (0.0, 0.0, 1.0, 1.0), header_bytes, total, 0.0, 0.0)
    page = pack_header(header)
    assert unpack_header(memoryview(page), total) == header
    read = parse(page + bytes(total - len(page)))
    assert read.fields["cell_id"] == cell_id
    assert list(read.columns) == [spec.name for spec in specs]


def test_an_empty_cell_has_no_heights() -> None:
    columns, total = plan_columns([ColumnSpec("xyz", np.dtype("<f8"), 3)], 0, 4096)
    header = SegmentHeader("a", "points", columns, 0, (0.0, 0.0, 1.0, 1.0), 4096, total)
    back = unpack_header(memoryview(pack_header(header)), total)
    assert back.columns[0].shape == (0, 3)
    assert math.isnan(back.z_min)
    assert math.isnan(back.z_max)


@pytest.mark.parametrize(
    ("name", "dtype", "unit"),
    [("n" * 41, "<f4", "m"), ("x", "<f4", "u" * 17), ("x", "<c8", "m"), ("x", "S4", "")],
)
def test_what_does_not_fit_is_refused(name: str, dtype: str, unit: str) -> None:
    columns, total = plan_columns([ColumnSpec(name, np.dtype(dtype), 1, unit)], 1, 4096)
    header = SegmentHeader("a", "points", columns, 1, (0.0, 0.0, 1.0, 1.0), 4096, total)
    with pytest.raises(ValueError):
        pack_header(header)


LATTICE_BYTES = (
    "0000000000000040 000000000000e03f 000000000000f07f"  # leaf 2, 0.5, infinite
    "fdffffffffffffff 0700000000000000 0000000000000000"  # first -3, 7, 0
    "0500000000000000 0400000000000000 0100000000000000"  # 5 x 4 x 1
)


def test_the_lattice_s_golden_bytes() -> None:
    header = replace(golden_header(), lattice=Lattice((2.0, 0.5, math.inf), (-3, 7, 0), (5, 4, 1)))
    page = pack_header(header)
    assert page[216:288] == bytes.fromhex(LATTICE_BYTES)
    assert page[:216] == golden_page()[:216]
    assert page[288:4024] == golden_page()[288:4024]
    assert unpack_header(memoryview(page), 4224) == header


def test_points_outside_the_box_golden_bytes() -> None:
    header = replace(golden_header(), outside_points=0x0102030405060708)
    page = pack_header(header)
    assert page[288:296] == bytes.fromhex("0807060504030201")
    assert page[:288] == golden_page()[:288]
    assert page[296:4024] == golden_page()[296:4024]
    assert unpack_header(memoryview(page), 4224) == header


def test_versions_golden_bytes() -> None:
    """The bytes that LAYOUT.md says are hashed."""
    stamp = SourceStamp(300, 1700000000123456789, 1700000001123456789).token
    assert stamp.hex() == "2c0100000000000015cd853dfe9c971715972079fe9c9717"
    hashed = (
        "080000002f6d2f612e706364"  # /m/a.pcd
        "18000000" + stamp.hex() +  # 24 bytes
        "00000000000034c0000000000000000000000000000000000000000000003440"  # -20, 0, 0, 20
    )  # fmt: skip
    box = (-20.0, 0.0, 0.0, 20.0)
    cell = cell_version("/m/a.pcd", stamp, box)
    assert cell == xxh3_64_intdigest(bytes.fromhex(hashed)) == 0x0CAE10A48722668C
    assert cell_version("/m/\udcff", b"", box) == xxh3_64_intdigest(
        b"\4\0\0\0/m/\xff" + bytes(4) + struct.pack("<4d", *box)
    )
    spec = "0d0000006e6474286c6561663d322e3029"  # ndt(leaf=2.0)
    assert layer_version(0x1122334455667788, "ndt(leaf=2.0)", 0x0103) == xxh3_64_intdigest(
        bytes.fromhex("8877665544332211" + spec + "03010000")
    )
    around = "0100000000000000ffffffffffffffff"
    assert layer_version(0x1122334455667788, "ndt(leaf=2.0)", 0x0103, [1, 2**64 - 1]) == xxh3_64_intdigest(
        bytes.fromhex("8877665544332211" + spec + "03010000" + around)
    )

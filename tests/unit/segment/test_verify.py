# SPDX-License-Identifier: Apache-2.0
"""Reading a segment's header and proving its bytes, without mapping it: no damaged byte is overlooked."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator

import numpy as np
import pytest

from shmmap.errors import SegmentCorrupt
from shmmap.segment.header import PublishBlock, pack_publish_block, read_header, verify_file
from shmmap.segment.layout import SegmentHeader
from tests.support.segments import write_segment

ROWS = 40_000
BLOCK = PublishBlock(7, 9)


@pytest.fixture
def segment() -> Iterator[tuple[int, SegmentHeader]]:
    """Return an open, published segment of 1.3 MB: more than is read at once."""
    with tempfile.TemporaryFile(dir="/dev/shm") as file:
        fd = file.fileno()
        rng = np.random.default_rng(1)
        xyz, intensity = rng.random((ROWS, 3), np.float32), rng.integers(0, 9, ROWS).astype("<u2")
        header = write_segment(fd, {"xyz": xyz, "intensity": intensity})
        os.pwrite(fd, pack_publish_block(BLOCK), header.header_bytes - 64)
        yield fd, header


def flip(fd: int, at: int) -> None:
    os.pwrite(fd, bytes([os.pread(fd, 1, at)[0] ^ 0x20]), at)


def test_a_whole_segment(segment: tuple[int, SegmentHeader]) -> None:
    fd, header = segment
    assert read_header(fd) == (header, BLOCK)
    assert verify_file(fd) == header


def test_each_byte_of_the_header(segment: tuple[int, SegmentHeader]) -> None:
    """All but eight matter: the padding after the two checksums, which neither covers."""
    fd, header = segment
    overlooked = []
    for at in range(header.header_bytes):
        flip(fd, at)
        try:
            read_header(fd)
            overlooked.append(at - header.header_bytes)
        except (SegmentCorrupt, UnicodeDecodeError):
            pass
        flip(fd, at)
    assert read_header(fd) == (header, BLOCK)
    assert overlooked == [-68, -67, -66, -65, -4, -3, -2, -1]


def test_bytes_of_the_columns(segment: tuple[int, SegmentHeader]) -> None:
    fd, header = segment
    for column in header.columns:
        for at in (0, 1, column.nbytes // 2, (1 << 20) % column.nbytes, column.nbytes - 1):
            flip(fd, column.offset + at)
            with pytest.raises(SegmentCorrupt, match=column.name):
                verify_file(fd)
            flip(fd, column.offset + at)
    verify_file(fd)


@pytest.mark.parametrize("nbytes", [0, 1, 100, 215, 216, 4095, 4096, 100_000])
def test_a_shorter_file(segment: tuple[int, SegmentHeader], nbytes: int) -> None:
    fd, _header = segment
    os.ftruncate(fd, nbytes)
    with pytest.raises(SegmentCorrupt):
        read_header(fd)


def test_a_segment_that_was_never_published(segment: tuple[int, SegmentHeader]) -> None:
    fd, header = segment
    os.pwrite(fd, bytes(64), header.header_bytes - 64)
    with pytest.raises(SegmentCorrupt, match="never published"):
        verify_file(fd)

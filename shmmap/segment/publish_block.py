# SPDX-License-Identifier: Apache-2.0
"""The last 64 bytes of a segment's header: which life of the daemon published it, as which version."""

from __future__ import annotations

import struct
import zlib
from typing import Final, NamedTuple

from shmmap.errors import SegmentCorrupt

__all__ = ["PUBLISH_BYTES", "PublishBlock", "pack_publish_block", "unpack_publish_block"]

PUBLISH_BYTES: Final = 64
PUBLISH: Final = struct.Struct("<8sQQ32xI4x")
PUBLISH_MAGIC: Final = b"PUBLISH\x00"
CRC: Final = struct.Struct("<II")


class PublishBlock(NamedTuple):
    """Which daemon life published the segment, and as which version of its cell."""

    epoch: int
    version: int


def pack_publish_block(block: PublishBlock) -> bytes:
    """Return the 64 bytes the daemon writes when it publishes a segment."""
    packed = PUBLISH.pack(PUBLISH_MAGIC, block.epoch, block.version, 0)
    return packed[:56] + CRC.pack(zlib.crc32(packed[:56]), 0)


def unpack_publish_block(header_page: memoryview, header_bytes: int) -> PublishBlock | None:
    """Read the publish block; None while the segment was never published.

    Raises
    ------
    SegmentCorrupt
        If it is neither empty nor whole.
    """
    raw = bytes(header_page[header_bytes - PUBLISH_BYTES : header_bytes])
    magic, epoch, version, crc = PUBLISH.unpack(raw)
    if magic == bytes(8):
        return None
    if magic != PUBLISH_MAGIC or crc != zlib.crc32(raw[:56]):
        raise SegmentCorrupt("the publish block is damaged")
    return PublishBlock(epoch, version)

# SPDX-License-Identifier: Apache-2.0
"""Packs and unpacks zstd frames: each object of a published map is one frame that begins with its size."""

from __future__ import annotations

from typing import Final

from shmmap.errors import MapDataError
from shmmap.lazy_imports import FOR_REMOTE, needed_packages

with needed_packages("a published map", together=FOR_REMOTE):
    import zstandard

LEVEL: Final = 3  # level 1 is twice as fast, and its frames are 1.6 % larger
DAMAGED: Final = "damaged"
"""`MapDataError.cause` of objects that differ from the published ones."""


def pack_frame(data: bytes | bytearray | memoryview) -> bytes:
    """Pack data into a frame, whose bytes depend on the release of zstd."""
    return zstandard.ZstdCompressor(level=LEVEL, write_content_size=True).compress(data)


def unpack_frame(frame: bytes | memoryview, max_bytes: int, *, name: str, exact: bool = False) -> bytes:
    """Return the unpacked content of a frame.

    Parameters
    ----------
    max_bytes
        Limit of the unpacked size, checked before memory is allocated.
    name
        Name of the object, for messages.
    exact
        Require exactly ``max_bytes`` bytes.

    Raises
    ------
    MapDataError
        The frame is incomplete or its content has another size (cause ``damaged``).
    """
    try:
        nbytes = zstandard.frame_content_size(frame)
        if nbytes < 0 or nbytes > max_bytes or (exact and nbytes != max_bytes):
            size = "an unknown number of" if nbytes < 0 else f"{nbytes:,}"
            limit = f"{max_bytes:,} are expected" if exact else f"at most {max_bytes:,} are read"
            raise MapDataError(f"its frame has {size} bytes, {limit}", path=name, cause=DAMAGED)
        data = zstandard.ZstdDecompressor().decompress(frame, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise MapDataError(f"no whole zstd frame: {error}", path=name, cause=DAMAGED) from None
    if len(data) != nbytes:
        raise MapDataError(
            f"its frame has {len(data):,} bytes, not {nbytes:,} as it says", path=name, cause=DAMAGED
        )
    return data

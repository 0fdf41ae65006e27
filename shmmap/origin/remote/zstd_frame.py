# SPDX-License-Identifier: Apache-2.0
"""One zstd frame: each object of a published map is one, with the size of what is in it at its start."""

from __future__ import annotations

from typing import Final

from shmmap.errors import MapDataError
from shmmap.lazy_imports import FOR_REMOTE, needed_packages

with needed_packages("a published map", together=FOR_REMOTE):
    import zstandard

__all__ = ["DAMAGED", "pack_frame", "unpack_frame"]

LEVEL: Final = 3  # 1 is twice as fast and leaves 1.6 % more
DAMAGED: Final = "damaged"
"""`MapDataError.cause` of bytes that are not what was published."""


def pack_frame(data: bytes | bytearray | memoryview) -> bytes:
    """Return a frame; its bytes depend on the release of zstd, what is in it does not."""
    return zstandard.ZstdCompressor(level=LEVEL, write_content_size=True).compress(data)


def unpack_frame(frame: bytes | memoryview, max_bytes: int, *, name: str, exact: bool = False) -> bytes:
    """Return what is in a frame.

    Parameters
    ----------
    max_bytes
        Limit of what is unpacked and of the memory for it: the frame says its size beforehand.
    name
        Of the object, for messages.
    exact
        It has to be ``max_bytes``, no less.

    Raises
    ------
    MapDataError
        If it is no whole frame or has more bytes (cause ``damaged``).
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

# SPDX-License-Identifier: Apache-2.0
"""Write PNG images (https://www.w3.org/TR/png/) row by row, with only a few rows in memory."""

from __future__ import annotations

import io
import struct
import zlib
from typing import IO, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.errors import BadRequest

_COLOUR_TYPES: Final = {1: 0, 2: 4, 3: 2, 4: 6}  # channels: grey, grey and alpha, RGB, RGBA


class PngWriter:
    """Writes an image of 8 or 16 bits a channel.

    Parameters
    ----------
    file
        Binary file to write into.
    columns, rows
        Size in pixels.
    channels
        1 grey, 2 grey and alpha, 3 RGB, 4 RGBA.
    bits
        8 or 16.
    """

    def __init__(
        self,
        file: IO[bytes],
        columns: int,
        rows: int,
        channels: int = 1,
        bits: int = 8,
    ) -> None:
        self._file = file
        self._left = rows
        self._row_shape = (columns, channels)
        self._dtype = np.dtype(np.uint8 if bits == 8 else ">u2")
        self._packer = zlib.compressobj(6)
        file.write(b"\x89PNG\r\n\x1a\n")
        colour_type = _COLOUR_TYPES[channels]
        self._chunk(b"IHDR", struct.pack(">IIBBBBB", columns, rows, bits, colour_type, 0, 0, 0))

    def add(self, rows: NDArray[np.unsignedinteger]) -> None:
        """Add rows, (n, columns) or (n, columns, channels), from top to bottom.

        Raises
        ------
        BadRequest
            The rows do not fit the image.
        """
        block = rows.reshape(len(rows), -1)
        columns, channels = self._row_shape
        if block.shape[1] != columns * channels or len(block) > self._left:
            raise BadRequest(f"rows of shape {rows.shape} do not fit the image")
        values = np.ascontiguousarray(block, self._dtype).view(np.uint8).reshape(len(block), -1)
        filtered = np.zeros((len(block), values.shape[1] + 1), np.uint8)
        step = channels * self._dtype.itemsize
        # filter 1: each byte minus that of the pixel to its left, which makes smooth pictures small
        filtered[:, 0] = 1
        filtered[:, 1:] = values
        filtered[:, 1 + step :] -= values[:, :-step]
        self._left -= len(block)
        data = self._packer.compress(filtered.tobytes())
        if data:
            self._chunk(b"IDAT", data)

    def finish(self) -> None:
        """Write the remaining bytes; all rows must have been added."""
        if self._left:
            raise BadRequest(f"{self._left} rows of the image are missing")
        self._chunk(b"IDAT", self._packer.flush())
        self._chunk(b"IEND", b"")

    def _chunk(self, kind: bytes, data: bytes) -> None:
        self._file.write(
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )


def png_bytes(pixels: NDArray[np.unsignedinteger]) -> bytes:
    """Return an image, (rows, columns) or (rows, columns, channels) uint8 or uint16, as a PNG."""
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    file = io.BytesIO()
    rows, columns = pixels.shape[:2]
    writer = PngWriter(file, columns, rows, channels, pixels.dtype.itemsize * 8)
    writer.add(pixels)
    writer.finish()
    return file.getvalue()

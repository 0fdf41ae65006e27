# SPDX-License-Identifier: Apache-2.0
"""PNG images as an independent reader sees them."""

from __future__ import annotations

import io

import numpy as np
import pytest

from shmmap import BadRequest
from shmmap.formats.png import PngWriter, png_bytes
from tests.support.pictures import png_pixels


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_png_there_and_back(channels: int, dtype: type[np.unsignedinteger]) -> None:
    shape = (7, 11) if channels == 1 else (7, 11, channels)
    pixels = np.random.default_rng(channels).integers(0, np.iinfo(dtype).max, shape).astype(dtype)
    read = png_pixels(png_bytes(pixels), ["", "LA", "RGB", "RGBA"][channels - 1])
    if read.dtype == np.uint8 and dtype == np.uint16:
        pixels = pixels >> 8  # Pillow reads the upper byte of several channels
    assert np.array_equal(read, pixels)


def test_png_row_by_row() -> None:
    file = io.BytesIO()
    writer = PngWriter(file, 5, 4)
    writer.add(np.zeros((3, 5), np.uint8))
    with pytest.raises(BadRequest):
        writer.finish()
    with pytest.raises(BadRequest):
        writer.add(np.zeros((2, 5), np.uint8))
    with pytest.raises(BadRequest):
        writer.add(np.zeros((1, 6), np.uint8))
    writer.add(np.full((1, 5), 9, np.uint8))
    writer.finish()
    assert png_pixels(file.getvalue())[:, 0].tolist() == [0, 0, 0, 9]


def test_png_with_a_palette() -> None:
    palette = np.random.default_rng(1).integers(0, 256, (200, 3)).astype(np.uint8)
    pixels = np.random.default_rng(2).integers(0, 200, (6, 9)).astype(np.uint8)
    png = png_bytes(pixels, palette.tobytes())
    assert np.array_equal(png_pixels(png), pixels)
    assert np.array_equal(png_pixels(png, "RGB"), palette[pixels])

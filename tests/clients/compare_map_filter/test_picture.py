# SPDX-License-Identifier: Apache-2.0
"""The picture, and PNG images as an independent reader sees them."""

from __future__ import annotations

import base64
import io
import re
import struct
import xml.etree.ElementTree as ElementTree
import zlib

import numpy as np
import pytest
from numpy.typing import NDArray
from shmmap_clients.compare_map_filter.picture import TopView
from shmmap_clients.png import PngWriter, png_bytes

from shmmap import BadRequest


def read_png(data: bytes) -> NDArray[np.integer]:
    """Decode what the filters 0 and 1 of PNG encode."""
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    at, packed, header = 8, b"", (0, 0, 0, 0)
    while at < len(data):
        length, kind = struct.unpack(">I4s", data[at : at + 8])
        body = data[at + 8 : at + 8 + length]
        (checksum,) = struct.unpack(">I", data[at + 8 + length : at + 12 + length])
        assert checksum == zlib.crc32(kind + body)
        if kind == b"IHDR":
            header = struct.unpack(">IIBBBBB", body)[:4]
        packed += body if kind == b"IDAT" else b""
        at += 12 + length
    columns, rows, bits, colour = header
    channels = {0: 1, 4: 2, 2: 3, 6: 4}[colour]
    step = channels * bits // 8
    raw = np.frombuffer(zlib.decompress(packed), np.uint8).reshape(rows, columns * step + 1)
    assert set(raw[:, 0].tolist()) <= {0, 1}
    values = raw[:, 1:].reshape(rows, columns, step)
    plain = np.where(raw[:, :1, None] == 1, np.cumsum(values, axis=1, dtype=np.uint8), values)
    flat = np.ascontiguousarray(plain.astype(np.uint8)).reshape(rows, -1)
    image = flat.view(">u2" if bits == 16 else np.uint8).reshape(rows, columns, channels)
    return image[:, :, 0] if channels == 1 else image


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_png_there_and_back(channels: int, dtype: type[np.unsignedinteger]) -> None:
    shape = (7, 11) if channels == 1 else (7, 11, channels)
    pixels = np.random.default_rng(channels).integers(0, np.iinfo(dtype).max, shape).astype(dtype)
    assert np.array_equal(read_png(png_bytes(pixels)), pixels)


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
    assert read_png(file.getvalue())[:, 0].tolist() == [0, 0, 0, 9]


@pytest.mark.parametrize("shift", [(0.0, 0.0), (-2.0, -50.0), (89_000.0, -1.0)])
def test_kept_points_are_red_on_top_of_grey(shift: tuple[float, float]) -> None:
    view = TopView(0.5)
    xyz = np.array([[0.1, 0.1, 0], [0.2, 0.2, 0], [5.1, 0.1, 0], [0.1, 3.1, 0], [np.nan, 0, 0], [1e30, 0, 0]])
    xyz[:, :2] += shift
    view.add(xyz, np.array([True, False, False, False, True, True]), (2.0, 1.0))
    text = view.svg("a < b", "note")
    root = ElementTree.fromstring(text)
    assert root.find("{http://www.w3.org/2000/svg}title") is not None
    match = re.search(r"base64,([^\"]+)", text)
    assert match is not None
    image = read_png(base64.b64decode(match.group(1)))
    assert image.shape[:2] == (15, 19)
    colours = {tuple(colour) for colour in image.reshape(-1, 3).tolist()}
    assert colours == {(255, 255, 255), (178, 186, 194), (214, 40, 40)}
    reds = np.argwhere((image == (214, 40, 40)).all(axis=2))
    greys = np.argwhere((image == (178, 186, 194)).all(axis=2))
    assert len(reds) == 1
    assert sorted((greys - reds[0]).tolist()) == [[-6, 0], [0, 10]]  # north is up


def test_a_picture_of_nothing() -> None:
    ElementTree.fromstring(TopView().svg("nothing", ""))


def test_a_long_drive_takes_no_more_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmmap_clients.compare_map_filter.picture._MOST", 500)
    fine, view = np.random.default_rng(3).uniform(-40, 40, (4000, 3)), TopView(0.1)
    kept = fine[:, 0] > 0
    for part in range(0, 4000, 400):
        view.add(fine[part : part + 400], kept[part : part + 400], (0.0, 0.0))
    assert len(view._kept) + len(view._removed) <= 500
    whole = TopView(view._pixel)
    whole.add(fine, kept, (0.0, 0.0))
    assert np.array_equal(view._kept + (_shift(whole) - _shift(view)), whole._kept)
    assert view.svg("a", "b").count("<image") == 1


def _shift(view: TopView) -> int:
    """What the offset of a view's indices makes of its packed pixels."""
    return (view._offset << 32) + view._offset

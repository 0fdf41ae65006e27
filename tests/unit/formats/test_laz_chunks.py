# SPDX-License-Identifier: Apache-2.0
"""LAZ whose compression contradicts its header or its bytes is refused, or read without believing it."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import laspy
import lazrs
import numpy as np
import pytest

from shmmap.errors import MapDataError
from shmmap.formats.cloud import describe, read_cloud
from shmmap.formats.las_reader import _refused
from tests.support.cloud_bytes import POINTS, las_file, patched

CHUNK_POINTS, ITEMS, FIRST_ITEM = 12, 32, 34  # in the LASzip record


def laz_file(folder: Path, form: int) -> tuple[Path, int, int]:
    """A file, and where its LASzip record and its points begin."""
    path = las_file(folder / "a.laz", form=form)
    data = path.read_bytes()
    return path, data.find(b"laszip encoded") + 52, struct.unpack_from("<I", data, 96)[0]


def refused(path: Path, words: str) -> None:
    for read in (describe, read_cloud):
        with pytest.raises(MapDataError) as caught:
            read(path)
        assert (caught.value.cause, words in str(caught.value)) == ("bad_las", True), str(caught.value)


@pytest.mark.parametrize("form", [0, 1, 2, 3, 6, 7, 8])
def test_every_point_format_is_read(tmp_path: Path, form: int) -> None:
    path, _, _ = laz_file(tmp_path, form)
    assert read_cloud(path).xyz[:, 0] == pytest.approx(np.arange(POINTS) * 0.1)


def test_extra_bytes_are_items_too(tmp_path: Path) -> None:
    for form in (3, 7):
        header = laspy.LasHeader(point_format=form, version="1.4")
        header.add_extra_dim(laspy.ExtraBytesParams(name="heat", type="float32"))
        las = laspy.LasData(header)
        las.x = las.y = las.z = np.arange(9.0)
        las.heat = np.arange(9, dtype=np.float32)
        las.write(str(tmp_path / "a.laz"))
        assert read_cloud(tmp_path / "a.laz").columns["heat"].tolist() == list(range(9))


@pytest.mark.parametrize("form", [3, 7])
def test_points_of_other_items_are_refused(tmp_path: Path, form: int) -> None:
    for at, code, value in (
        (ITEMS, "H", 0),  # lazrs panics at no items at all
        (ITEMS, "H", 1),
        (ITEMS, "H", 60000),
        (FIRST_ITEM, "H", 11),
        (FIRST_ITEM + 2, "H", 19),
    ):
        path, record, _ = laz_file(tmp_path, form)
        refused(patched(path, record + at, code, value), "LASzip record")


@pytest.mark.parametrize("form", [3, 7])
def test_a_chunk_of_more_points_than_memory_is_read_point_by_point(tmp_path: Path, form: int) -> None:
    """lazrs would ask for 140 GB at once, and end the process."""
    path, record, _ = laz_file(tmp_path, form)
    expected = read_cloud(path)
    cloud = read_cloud(patched(path, record + CHUNK_POINTS, "I", 2**32 - 2))
    for name, values in expected.columns.items():
        assert np.array_equal(cloud.columns[name], values), name


def test_layers_behind_the_chunk_are_refused(tmp_path: Path) -> None:
    for layer in range(10):
        path, _, data_at = laz_file(tmp_path, 7)
        refused(patched(path, data_at + 8 + 36 + 4 + 4 * layer, "I", 2**32 - 1), "bytes of layers")


def test_a_chunk_without_its_first_point_is_refused(tmp_path: Path) -> None:
    path, _, data_at = laz_file(tmp_path, 7)
    chunk = path.read_bytes()[data_at + 8 :]
    table = io.BytesIO()
    vlr = lazrs.LazVlr.new_for_compression(7, 0)
    lazrs.write_chunk_table(table, [(0, 20)], vlr)
    moved = struct.pack("<q", data_at + 28)
    path.write_bytes(path.read_bytes()[:data_at] + moved + chunk[:20] + table.getvalue())
    refused(patched(path, 247, "Q", 1), "within its first point")


@pytest.mark.parametrize("form", [3, 7])
def test_an_empty_chunk_at_the_end_is_read(tmp_path: Path, form: int) -> None:
    """Where the points fill the chunks before it."""
    path, record, data_at = laz_file(tmp_path, form)
    expected = read_cloud(path)
    data = path.read_bytes()
    (table_at,) = struct.unpack_from("<q", data, data_at)
    table = io.BytesIO()
    chunks = [(0, table_at - data_at - 8), (0, 0)]
    lazrs.write_chunk_table(table, chunks, lazrs.LazVlr.new_for_compression(form, 0))
    path.write_bytes(data[:table_at] + table.getvalue())
    cloud = read_cloud(patched(path, record + CHUNK_POINTS, "I", POINTS))
    for name, values in expected.columns.items():
        assert np.array_equal(cloud.columns[name], values), name


def test_a_table_of_more_bytes_than_the_file_is_refused(tmp_path: Path) -> None:
    path, _, data_at = laz_file(tmp_path, 3)
    data = path.read_bytes()
    (table_at,) = struct.unpack_from("<q", data, data_at)
    table = io.BytesIO()
    lazrs.write_chunk_table(table, [(0, 2**31 - 1)], lazrs.LazVlr.new_for_compression(3, 0))
    path.write_bytes(data[:table_at] + table.getvalue())
    refused(path, "announces more than the")


def test_a_panic_of_the_decompressor_is_a_refusal(tmp_path: Path) -> None:
    path, record, data_at = laz_file(tmp_path, 3)
    patched(path, record + ITEMS, "H", 0)
    laszip = path.read_bytes()[record:][: ITEMS + 2]
    with open(path, "rb") as file:
        file.seek(data_at)
        reader = lazrs.ParLasZipDecompressor(file, laszip)
        with pytest.raises(MapDataError, match="LazItem"), _refused(str(path), ""):
            reader.seek(0)


def test_an_interrupt_is_not_a_refusal() -> None:
    with pytest.raises(KeyboardInterrupt), _refused("a.laz", ""):
        raise KeyboardInterrupt

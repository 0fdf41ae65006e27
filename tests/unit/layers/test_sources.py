# SPDX-License-Identifier: Apache-2.0
"""What a layer is computed of: never more than fits, and a bad neighbour is only left out."""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest

from shmmap.errors import MapDataError
from shmmap.formats.pcd.reader import PcdReader
from shmmap.layers import sources
from shmmap.layers.build import derive, read_halo
from shmmap.layers.contract import Box
from shmmap.layers.sources import FILES, CellJob, CellSource, read_segment, read_source
from shmmap.layers.spec import parse_layer
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.header import PublishBlock, pack_publish_block
from shmmap.segment.version import Source
from tests.support.divided_map import random_points, write_pcd

BOX: Box = (0.0, 0.0, 20.0, 20.0)
XYZ = np.dtype("<f4")


def bomb(path: Path) -> Path:
    """A file of a few megabytes that claims 1.2 GB of points; its sizes are ones that could be true."""
    points = 100_000_000
    header = (
        "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA binary_compressed\n"
    ).encode()
    with path.open("wb") as file:
        file.write(header + struct.pack("<II", 15 << 20, 12 * points))
        file.truncate(len(header) + 8 + (15 << 20))
    return path


def no_reading(*_: object, **__: object) -> NoReturn:
    raise AssertionError("nothing of it may be read")


def test_a_file_that_claims_too_much_is_refused_before_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(PcdReader, "blocks", no_reading)
    path = bomb(tmp_path / "bomb.pcd")
    with pytest.raises(MapDataError) as caught:
        read_source(str(path), BOX, ("xyz",))
    assert caught.value.cause == "too_large"
    assert str(path) in caught.value.message
    assert "1.1 GiB" in caught.value.message
    assert "smaller cells" in caught.value.hint


def test_so_is_its_segment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether the points are in memory must not decide whether there is a layer."""
    path = tmp_path / "cell.pcd"
    write_pcd(path, random_points(np.random.default_rng(1), (0, 0), 100))
    directory = ShmDirectory("/dev/shm")
    fd = directory.create()
    with open(fd, "r+b"):
        made = derive(parse_layer("crop(z_min=-1000)"), CellJob("cell", Source(str(path)), BOX), fd)
        os.pwrite(fd, pack_publish_block(PublishBlock(1, 2)), made.header.header_bytes - 64)
        assert len(read_segment(fd, BOX, None).points) == 100
        monkeypatch.setattr(sources, "MAX_SOURCE_BYTES", 100 * 16 - 1)
        with pytest.raises(MapDataError) as caught:
            read_segment(fd, BOX, None)
    directory.close()
    assert caught.value.cause == "too_large"


def test_a_neighbour_that_claims_too_much_is_left_out_and_named(tmp_path: Path) -> None:
    good = tmp_path / "good.pcd"
    write_pcd(good, random_points(np.random.default_rng(1), (20, 0), 100))
    paths = [str(bomb(tmp_path / "bomb.pcd")), str(good)]
    halo = read_halo(FILES, [Source(path) for path in paths], BOX, 20.0, XYZ)
    assert halo.xyz.shape == (100, 3)
    assert [digest == bytes(16) for _, digest in halo.seen] == [True, False]
    (warning,) = halo.warnings
    assert warning.startswith(f"made without a neighbour: {paths[0]}: ")


def test_without_memory_for_a_neighbour_the_neighbour_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No layer is made without it: it would be kept as the one for these files."""

    def full(*_: Any) -> CellSource:
        raise MemoryError

    monkeypatch.setattr(sources, "read_source", full)
    with pytest.raises(MapDataError, match=r"neighbour\.pcd: this neighbour takes more memory") as caught:
        read_halo(FILES, [Source(str(tmp_path / "neighbour.pcd"))], BOX, 5.0, XYZ)
    assert "smaller cells" in caught.value.hint

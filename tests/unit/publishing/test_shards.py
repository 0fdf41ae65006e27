# SPDX-License-Identifier: Apache-2.0
"""Cells divided into shards, sides that do not wander, and objects found by what is in them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shmmap.errors import BadRequest, MapDataError
from shmmap.origin.catalogue import Catalogue

zstandard = pytest.importorskip("zstandard", reason="zstandard is not installed")

from shmmap.origin.remote.published_index import LayerObjects, pack_shard, shard_keys  # noqa: E402
from shmmap.publishing.messages import CellSent, KnownObjects, LayerSent, write_known_objects  # noqa: E402
from shmmap.publishing.shards import (  # noqa: E402
    CellObjects,
    check_cells,
    divide_into_shards,
    shard_side,
)


def catalogue_of(boxes: Any, names: list[bytes] | None = None) -> Catalogue:
    boxes = np.asarray(boxes, np.float64)
    names = sorted(names or [b"%06d.pcd" % i for i in range(len(boxes))])
    return Catalogue(
        id_prefix="/maps/", names=np.array(names), boxes=boxes, stamps=np.zeros((len(boxes), 3), np.int64)
    )


def lattice(columns: int, rows: int, size: float = 20.0, at: float = 0.0) -> Any:
    x, y = np.meshgrid(np.arange(columns) * size + at, np.arange(rows) * size + at)
    low = np.column_stack([x.ravel(), y.ravel()])
    return np.hstack([low, low + size])


def filled(catalogue: Catalogue) -> CellObjects:
    objects = CellObjects(len(catalogue), ("points",))
    for row in range(len(catalogue)):
        digest = row.to_bytes(32, "big")
        layer = LayerSent(digest, row + 1, 4096 + row, digest[::-1], 0)
        objects.set(row, CellSent(row, row, -1.0, 2.0, (layer,)))
    return objects


def test_each_cell_is_in_the_shard_of_its_corner() -> None:
    rng = np.random.default_rng(1)
    boxes = lattice(70, 50, at=-300.0)[rng.permutation(3500)]
    catalogue = catalogue_of(boxes)
    side = shard_side(catalogue, 1, None)
    assert side == 640.0
    shards = list(divide_into_shards(catalogue, filled(catalogue), side))
    assert [key for key, _ in shards] == sorted(key for key, _ in shards)
    assert sum(len(shard) for _, shard in shards) == 3500
    names = catalogue.names.tolist()
    for key, shard in shards:
        assert (shard_keys(shard.boxes, side) == key).all()
        assert list(shard.names) == sorted(shard.names)
        for row, name in enumerate(shard.names):
            index = names.index(name)
            assert shard.boxes[row].tolist() == boxes[index].tolist()
            assert shard.points[row] == index
            assert shard.layers["points"].name(row).sha256 == index.to_bytes(32, "big")
            assert np.isnan(shard.z[row]).all() == (index == 0), "a cell without points has no heights"


def test_the_side_stays_as_cells_are_added() -> None:
    before = shard_side(catalogue_of(lattice(10, 10, 20.0)), 1, None)
    wider = catalogue_of(np.vstack([lattice(10, 10, 20.0), [[500.0, 500, 560, 520]]]))
    assert wider.mean_size != (20.0, 20.0)
    assert shard_side(wider, 1, before) == before == 640.0
    assert shard_side(catalogue_of(lattice(4, 4, 20.000001)), 1, None) == 640.0, "last bits do not matter"
    assert shard_side(catalogue_of(lattice(4, 4, 1000.0)), 1, before) == 32_000.0
    assert shard_side(catalogue_of([[5.0, 5, 5, 5]]), 1, None) == 32.0, "a cell without an extent"


def test_small_cells_among_large_ones_get_smaller_shards() -> None:
    boxes = np.vstack([lattice(150, 150, 1.0), [[0.0, 0, 40_000, 40_000]] * 50])
    catalogue = catalogue_of(boxes)
    side = shard_side(catalogue, 2, None)
    shards = list(divide_into_shards(catalogue, filled(catalogue), side))
    assert max(len(shard) for _, shard in shards) <= 8192
    assert max(len(pack_shard(shard)) for _, shard in shards) < 4 << 20


def test_too_many_cells_at_one_place_or_too_far_out() -> None:
    with pytest.raises(MapDataError, match="cells begin within"):
        shard_side(catalogue_of([[0.0, 0, 20, 20]] * 9000), 1, None)
    with pytest.raises(MapDataError, match="too far out"):
        shard_side(catalogue_of([[1e12, 0, 1e12 + 0.001, 0.001]]), 1, None)


@pytest.mark.parametrize("name", [b"\xff.pcd", b"../a.pcd", b"a//b.pcd"])
def test_names_that_cannot_be_published(name: bytes) -> None:
    catalogue = catalogue_of([[0.0, 0, 20, 20]], [name])
    with pytest.raises(BadRequest, match="cannot be published"):
        check_cells(catalogue)


def test_cells_that_no_reader_takes() -> None:
    for far in (-1e308, 1e13):
        with pytest.raises(MapDataError, match="farther out than 1e\\+12 m"):
            check_cells(catalogue_of([[min(far, 0.0), 0, max(far, 0.0), 20]], [b"a.pcd"]))


def test_objects_are_found_by_their_content(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    contents = rng.integers(0, 256, (500, 32)).astype(np.uint8)
    contents[3, -5:] = 0  # a hash may end with zero bytes
    contents[4] = 0
    layers = [
        LayerObjects(
            np.arange(250, dtype=np.uint32),
            np.full(250, 4096, np.uint32),
            contents[part],
            contents[part][::-1],
        )
        for part in (slice(0, 250), slice(250, 500))
    ]
    assert write_known_objects(tmp_path / "known", layers) == 500
    known = KnownObjects(str(tmp_path / "known"))
    for layer in layers:
        for row in range(250):
            assert known.find(layer.contents[row].tobytes()) == layer.name(row)
    absent = rng.integers(0, 256, (100, 32)).astype(np.uint8)
    assert all(known.find(one.tobytes()) is None for one in absent)
    almost = contents[3].copy()
    almost[-1] = 1
    assert known.find(almost.tobytes()) is None
    assert KnownObjects("").find(bytes(32)) is None
    assert write_known_objects(tmp_path / "none", []) == 0
    assert KnownObjects(str(tmp_path / "none")).find(bytes(32)) is None

# SPDX-License-Identifier: Apache-2.0
"""Where voxels lie: by floor, by shift, brick by brick; on borders and below zero, too."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from shmmap.chunks.voxels import (
    CHUNK_VOXELS,
    FURTHEST_INDEX,
    PLACE_X,
    PLACE_Y,
    PLACE_Z,
    ChunkKey,
    in_chunk,
    voxel_centers,
    voxel_indices,
    voxels_of,
)
from shmmap.errors import BadRequest

INDEX = st.integers(-FURTHEST_INDEX, FURTHEST_INDEX - 1)


@given(st.lists(st.tuples(INDEX, INDEX, INDEX), min_size=1, max_size=20))
def test_chunk_and_place_name_a_voxel(voxels: list[tuple[int, int, int]]) -> None:
    indices = np.array(voxels, np.int32)
    keys, places = in_chunk(indices)
    for voxel, key, place in zip(voxels, keys.tolist(), places.tolist(), strict=True):
        chunk = ChunkKey(*key)
        assert chunk.possible
        assert chunk == tuple(index // 64 for index in voxel)
        x, y, z = (index % 64 for index in voxel)
        brick = (z // 4 * 8 + y // 8) * 8 + x // 8
        assert place == brick * 256 + (z % 4 * 8 + y % 8) * 8 + x % 8
        assert voxels_of(chunk, np.array([place])).tolist() == [list(voxel)]


def test_each_place_has_one_voxel() -> None:
    places = PLACE_X[None, None, :] + PLACE_Y[None, :, None] + PLACE_Z[:, None, None]
    assert np.array_equal(np.sort(places.reshape(-1)), np.arange(CHUNK_VOXELS))


@pytest.mark.parametrize("resolution", [0.05, 0.1, 0.2, 1.0, 0.3])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_points_on_borders_fall_as_double_precision_says(resolution: float, dtype: type) -> None:
    rng = np.random.default_rng(5)
    borders: NDArray[np.floating] = (rng.integers(-2000, 2000, (500, 3)) * resolution).astype(dtype)
    points = np.concatenate(
        [borders, np.nextafter(borders, dtype(np.inf)), np.nextafter(borders, dtype(-np.inf))]
    )
    inverse = 1.0 / resolution
    expected = [[math.floor(float(value) * inverse) for value in point] for point in points]
    assert voxel_indices(points, resolution).tolist() == expected


def test_minus_a_little_is_not_zero() -> None:
    assert voxel_indices(np.array([[-1e-9, 0.0, -0.0]]), 0.1).tolist() == [[-1, 0, 0]]


def test_a_voxel_s_middle_lies_in_it() -> None:
    indices = np.random.default_rng(1).integers(-(10**6), 10**6, (1000, 3)).astype(np.int32)
    assert np.array_equal(voxel_indices(voxel_centers(indices, 0.05), 0.05), indices)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e300, FURTHEST_INDEX * 0.1 * 1.001])
def test_what_is_no_place_is_refused(value: float) -> None:
    with pytest.raises(BadRequest, match="107374182 m"):
        voxel_indices(np.array([[0.0, value, 0.0]]), 0.1)


def test_keys_as_text() -> None:
    key = ChunkKey(3, -1, 0)
    assert key.text == "3_-1_0"
    assert ChunkKey.from_text("3_-1_0") == key
    assert key.first_voxel == (192, -64, 0)
    assert key.box(0.5) == (96.0, -32.0, 0.0, 128.0, 0.0, 32.0)
    assert [key.distance(other) for other in (key, ChunkKey(4, -2, 1), ChunkKey(3, 4, 0))] == [0, 1, 5]


@pytest.mark.parametrize(
    "text", ["", "1_2", "1_2_3_4", "a_b_c", "01_2_3", "1_2_ 3", "1_2_99999999", "+1_2_3"]
)
def test_what_is_no_key_is_refused(text: str) -> None:
    with pytest.raises(BadRequest, match="not the key of a chunk"):
        ChunkKey.from_text(text)

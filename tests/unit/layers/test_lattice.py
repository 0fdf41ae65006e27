# SPDX-License-Identifier: Apache-2.0
"""Points sorted into voxels, against a dictionary of voxels: any cloud, near borders, far from the origin."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from shmmap.layers import build_layer, voxels
from shmmap.layers.voxels import CONVENTIONS, group_points, voxel_covariances
from tests.support.layer_oracles import covariance_of, voxels_of

ORIGINS = st.sampled_from([0.0, 89_570.0, -42_300.5, 1e6, -3e5])


@st.composite
def clouds(draw: st.DrawFn) -> tuple[NDArray[Any], float]:
    """A few points, many of them on faces of voxels or a hair beside, doubled, or not finite; and a leaf."""
    leaf = draw(st.sampled_from([0.1, 0.3, 0.5, 2.0, 7.77]))
    dtype = draw(st.sampled_from([np.float32, np.float64]))
    origin = [draw(ORIGINS) for _ in range(3)]
    steps = st.integers(-30, 30).map(lambda step: step * leaf)
    place = steps | st.floats(-20, 20, width=32) | st.sampled_from([np.nan, np.inf, -np.inf])
    cloud = np.array(draw(st.lists(st.tuples(place, place, place), max_size=30)), np.float64).reshape(-1, 3)
    cloud = (cloud + origin).astype(dtype)
    finite = cloud[np.isfinite(cloud).all(axis=1)]
    hairs = [np.nextafter(finite, dtype(side)) for side in (np.inf, -np.inf)]
    return np.concatenate([cloud, finite[:5], finite[:5], *hairs]), leaf


@given(clouds())
@settings(max_examples=150, deadline=None)
def test_every_point_is_in_its_voxel(given_cloud: tuple[NDArray[Any], float]) -> None:
    cloud, leaf = given_cloud
    members = voxels_of(cloud, (leaf, leaf, leaf))
    order = sorted(members, key=lambda index: index[::-1])  # x fastest
    by_table = group_points(cloud, (leaf, leaf, leaf))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(voxels, "_SMALL_TABLE", -1)  # no table is small enough
        patch.setattr(voxels, "_DENSE_POINTS", -1)
        by_sorting = group_points(cloud, (leaf, leaf, leaf))
    for grouping in (by_table, by_sorting):
        assert [tuple(index) for index in grouping.indices.tolist()] == order
        assert grouping.counts.tolist() == [len(members[index]) for index in order]
        found = {index: np.flatnonzero(grouping.rows == row).tolist() for row, index in enumerate(order)}
        assert found == members


@given(clouds())
@settings(max_examples=60, deadline=None)
def test_moments_and_covariances_of_any_voxel(given_cloud: tuple[NDArray[Any], float]) -> None:
    cloud, leaf = given_cloud
    finite = cloud[np.isfinite(cloud).all(axis=1)]
    near = finite[(np.abs(finite - finite[:1]) < 40 * leaf).all(axis=1)]  # the table covers their box
    table = build_layer(f"ndt(leaf={leaf},min_points=2)", near)
    members = {index: rows for index, rows in voxels_of(near, (leaf,) * 3).items() if len(rows) > 1}
    assert table.rows == len(members)
    assert table.lattice is not None
    for convention in CONVENTIONS:
        covariances, inverses = voxel_covariances(table["count"], table["scatter"], convention)
        for index, rows in members.items():
            i, j, k = np.subtract(index, table.lattice.first)
            row = table["table"][k, j, i]
            points = near[rows].astype(np.float64)
            assert np.abs(table["mean"][row] - points[0] - (points - points[0]).mean(axis=0)).max() < 1e-9
            expected = covariance_of(near[rows], convention)
            if expected is None:
                assert not inverses[row].any()
                continue
            for got, want in zip((covariances, inverses), expected, strict=True):
                off = np.abs(got[row, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(3, 3) - want).max()
                assert off <= 1e-6 * np.abs(want).max()

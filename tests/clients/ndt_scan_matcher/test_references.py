# SPDX-License-Identifier: Apache-2.0
"""Alignments and voxel statistics that the C++ originals computed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from shmmap_clients.ndt_scan_matcher import NdtMatcher

from tests.clients.ndt_scan_matcher.references import (
    assert_as_the_original,
    clouds,
    reference_rows,
    settings_of,
    target,
)


@pytest.mark.parametrize(("backend", "count"), [("numba", 32 + 78), ("numpy", 32)])
def test_alignments_equal_the_originals(data_dir: Path, backend: str, count: int) -> None:
    """Numpy aligns the recorded ones alone: the others differ in leaf sizes and guesses."""
    folder = data_dir / "ndt"
    rows = reference_rows(folder)
    assert len(rows) == 32 + 78
    for row in rows[:count]:
        settings, guess = settings_of(row)
        with NdtMatcher(settings, backend=backend) as matcher:
            matcher.set_map(target(folder, row["dataset"], row["leaf"]))
            assert_as_the_original(matcher.align(clouds(folder, row["dataset"])[1], guess), row)


@pytest.mark.parametrize("leaf", [1.0, 2.0])
@pytest.mark.parametrize("covariance", ["autoware", "pclomp", "pcl"])
def test_voxel_statistics_equal_the_originals(data_dir: Path, leaf: float, covariance: str) -> None:
    voxel_map = target(data_dir / "ndt", "koide3 pair 0.1 m", leaf)
    cell = voxel_map.cells["map"]
    inverse = voxel_map.inverses("map", covariance)  # type: ignore[arg-type]
    with np.load(data_dir / "ndt" / f"target_ds0.1_leaf{leaf}_{covariance}.npz") as dump:
        ijk, count, mean, icov = dump["ijk"], dump["count"], dump["mean"], dump["icov"].reshape(-1, 3, 3)
    kept = count >= 6
    assert kept.sum() >= (inverse[:, 0] > 0).sum() - 1
    rows = cell.lattice[tuple((ijk[kept] - cell.lattice_origin).T)]
    assert (rows >= 0).all()
    np.testing.assert_array_equal(cell.count[rows], count[kept])
    np.testing.assert_allclose(cell.mean[rows] + cell.origin, mean[kept], atol=1e-9)
    ours = inverse[rows][:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    np.testing.assert_allclose(ours, icov[kept], atol=1e-8 * np.abs(icov[kept]).max())

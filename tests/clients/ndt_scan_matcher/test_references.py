# SPDX-License-Identifier: Apache-2.0
"""Alignments and voxel statistics that the C++ originals computed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from shmmap_clients.ndt_scan_matcher import (
    NdtMatcher,
    Result,
)

from tests.clients.ndt_scan_matcher.references import clouds, settings_of, target, usable


def align(folder: Path, row: dict[str, Any], backend: str) -> Result:
    settings, guess, *_ = settings_of(row)
    with NdtMatcher(settings, backend=backend) as matcher:
        matcher.set_map(target(folder, row["dataset"], row["leaf"]))
        return matcher.align(clouds(folder, row["dataset"])[1], guess)


@pytest.mark.parametrize("backend", ["numba", "numpy"])
def test_alignments_equal_the_originals(data_dir: Path, backend: str) -> None:
    folder = data_dir / "ndt"
    rows = json.loads((folder / "reference_results.json").read_text(encoding="utf-8"))["results"]
    checked = 0
    for row in filter(usable, rows):
        result = align(folder, row, backend)
        T = np.array(row["T"])
        what = f"{row['dataset']} {row['name']} eps {row['eps']} guess {row['guess_xyz_yaw']}"
        assert result.iterations == row["iters"], what
        np.testing.assert_allclose(result.T_map_base[:3, 3], T[:3, 3], atol=1e-4, err_msg=what)
        np.testing.assert_allclose(result.T_map_base[:3, :3], T[:3, :3], atol=1e-5, err_msg=what)
        assert result.transform_probability == pytest.approx(row["tp"], abs=1e-4), what
        if "nvtl" in row:
            assert result.nvtl == pytest.approx(row["nvtl"], abs=1e-4), what
        checked += 1
    assert checked == 32


def test_alignments_equal_the_originals_at_other_leaf_sizes_and_guesses(data_dir: Path) -> None:
    folder = data_dir / "ndt"
    rows = json.loads(Path(__file__).with_name("reference_alignments.json").read_text(encoding="utf-8"))
    for row in rows["alignments"]:
        result = align(folder, row, "numba")
        T = np.array(row["T"]).reshape(3, 4)
        what = str({name: value for name, value in row.items() if name != "T"})
        assert result.iterations == row["iterations"], what
        np.testing.assert_allclose(result.T_map_base[:3, 3], T[:, 3], atol=1e-4, err_msg=what)
        np.testing.assert_allclose(result.T_map_base[:3, :3], T[:, :3], atol=1e-5, err_msg=what)
        assert result.transform_probability == pytest.approx(row["transform_probability"], abs=1e-4), what
        if "nvtl" in row:
            assert result.nvtl == pytest.approx(row["nvtl"], abs=1e-4), what
    assert len(rows["alignments"]) == 78


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

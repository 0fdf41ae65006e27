# SPDX-License-Identifier: Apache-2.0
"""What the C++ originals were given, and what they found: 32 recorded alignments, and 78 kept beside this."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from shmmap_clients.ndt_scan_matcher import Result, Settings, VoxelMap, matrix_from_pose, voxel_cell
from shmmap_clients.ndt_scan_matcher.matching.evaluation import Neighbors

from shmmap import read_cloud

SEARCH: dict[str, Neighbors] = {"KDTREE": "radius", "DIRECT7": "direct7", "DIRECT1": "direct1"}


@cache
def clouds(folder: Path, dataset: str) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    if dataset == "synthetic":
        return read_cloud(folder / "synthetic_map.pcd").xyz, read_cloud(folder / "synthetic_scan1500.pcd").xyz
    with np.load(folder / "target_ds0.1_points.npz") as a, np.load(folder / "source_ds0.1_points.npz") as b:
        return a["xyz"], b["xyz"]


@cache
def target(folder: Path, dataset: str, leaf: float) -> VoxelMap:
    return VoxelMap({"map": voxel_cell(clouds(folder, dataset)[0], leaf)})


def usable(row: dict[str, Any]) -> bool:
    # DIRECT26 leaves out the centre; Autoware itself does not use its line search
    return "DIRECT26" not in row["name"] and "ls=1" not in row["name"]


def settings_of(row: dict[str, Any]) -> tuple[Settings, NDArray[np.float64]]:
    """Settings and guess that a reference was aligned with."""
    if "program" in row:
        settings = Settings(
            "autoware" if row["program"] == "autoware" else "pclomp",
            row["neighbors"],
            epsilon=row["epsilon"],
            max_iterations=row["max_iterations"],
        )
        return settings, matrix_from_pose(np.array(row["guess"]))
    settings = Settings(
        "autoware" if row["name"].startswith("autoware") else "pclomp",
        next(ours for theirs, ours in SEARCH.items() if theirs in row["name"]),
        epsilon=row["eps"],
        max_iterations=row["max_iter"],
        step_size=row["step_size"],
    )
    x, y, z, yaw = row["guess_xyz_yaw"]
    return settings, matrix_from_pose(np.array([x, y, z, 0.0, 0.0, yaw]))


def assert_as_the_original(
    result: Result, row: dict[str, Any], t: float = 1e-4, R: float = 1e-5, score: float = 1e-4
) -> None:
    """Compare a result with what the original found: metres, elements of the rotation, scores per point."""
    T = np.array(row["T"]).reshape(-1, 4)
    assert result.iterations == row.get("iterations", row.get("iters")), row
    np.testing.assert_allclose(result.T_map_base[:3, 3], T[:3, 3], atol=t, err_msg=str(row))
    np.testing.assert_allclose(result.T_map_base[:3, :3], T[:3, :3], atol=R, err_msg=str(row))
    probability = row["transform_probability"] if "transform_probability" in row else row["tp"]
    assert abs(result.transform_probability - probability) <= score, row
    if "nvtl" in row:
        assert abs(result.nvtl - row["nvtl"]) <= score, row


def reference_rows(folder: Path) -> list[dict[str, Any]]:
    """All of them, the recorded ones first."""
    recorded = json.loads((folder / "reference_results.json").read_text(encoding="utf-8"))["results"]
    kept = json.loads(Path(__file__).with_name("reference_alignments.json").read_text(encoding="utf-8"))
    return [*filter(usable, recorded), *kept["alignments"]]

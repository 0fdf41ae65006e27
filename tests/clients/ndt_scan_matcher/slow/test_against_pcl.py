# SPDX-License-Identifier: Apache-2.0
"""The variant ``pcl`` beside PCL itself, at any leaf size and guess; needs g++ and libpcl-dev.

What PCL does differently is repeated: it stops where a step's translation, squared, is below epsilon (0.1 by
default: a third of a metre), takes angles below 1e-4 for zero in derivatives, and clips its line search.  Two
things are not.  It moves points and measures how near centroids are in float32, which the tolerances are for.
And a voxel that it has refused (points all the same) counts for it as one of zero inverse covariance; these
clouds have none.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from shmmap_clients.ndt_scan_matcher import (
    NdtMatcher,
    Settings,
    VoxelMap,
    matrix_from_pose,
    pose_from_matrix,
    voxel_cell,
)

from tests.clients.ndt_scan_matcher.scene import TRUTH, scan_from, street
from tests.support.compiled_programs import PclNdt, build_pcl_ndt

LEAVES = (0.8, 1.0, 1.5, 2.0, 2.7, 4.0)

Points = NDArray[np.float32]


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    program = build_pcl_ndt(tmp_path_factory.mktemp("pcl"), optimize="-O1")
    if program is None:
        pytest.skip("g++ or libpcl-dev (1.13 or newer) is missing")
    return program


@pytest.fixture(scope="module")
def clouds() -> tuple[Points, Points]:
    return street().astype(np.float32), scan_from(street(seed=7), TRUTH, 1500).astype(np.float32)


def poses(leaf: float, count: int) -> NDArray[np.float64]:
    """Poses about the truth, up to 0.6 m and some degrees away."""
    rng = np.random.default_rng(int(leaf * 10))
    return TRUTH + rng.uniform(-1, 1, (count, 6)) * [0.6, 0.6, 0.4, 0.03, 0.03, 0.06]


def beyond(ours: NDArray[np.float64], theirs: NDArray[np.float64]) -> float:
    """The largest difference, of the largest number."""
    return float(np.abs(ours - theirs).max() / np.abs(theirs).max())


@pytest.mark.parametrize("leaf", LEAVES)
def test_scores_and_derivatives(program: Path, clouds: tuple[Points, Points], leaf: float) -> None:
    target, source = clouds
    off = []
    with PclNdt(program, target, source, leaf) as pcl, NdtMatcher(Settings("pcl")) as matcher:
        matcher.set_map(VoxelMap({"map": voxel_cell(target, leaf)}))
        for pose in poses(leaf, 10):
            theirs = pcl.evaluate(pose)
            (ours,) = matcher.evaluate(source, pose[None])
            score = abs(ours.score / theirs.score - 1)
            off.append([score, beyond(ours.gradient, theirs.gradient), beyond(ours.hessian, theirs.hessian)])
    assert np.quantile(off, 0.9) < 1e-4
    assert np.max(off) < 1e-3  # a centroid at the rim of the radius is near for one and not for the other


@pytest.mark.parametrize("leaf", LEAVES)
def test_every_step(program: Path, clouds: tuple[Points, Points], leaf: float) -> None:
    # Over many steps rounding grows: from a guess 1 um beside another this variant, whose basin is narrow,
    # may end elsewhere, and so may PCL's.  From the same place both take the same step.
    target, source = clouds
    off = []
    settings = Settings("pcl", epsilon=1e-6, max_iterations=20)
    with PclNdt(program, target, source, leaf) as pcl, NdtMatcher(settings) as matcher:
        matcher.set_map(VoxelMap({"map": voxel_cell(target, leaf)}))
        for pose in poses(leaf, 5):
            transforms = matcher.align(source, matrix_from_pose(pose)).transforms
            for before, after in pairwise(transforms):
                theirs = pcl.align(pose_from_matrix(before), 1e-6, 1)
                off.append(np.abs(after - theirs.T).max())
    assert len(off) > 50
    assert np.quantile(off, 0.95) < 1e-5
    assert np.max(off) < 5e-4


@pytest.mark.parametrize("leaf", [2.0, 2.7, 4.0])
def test_whole_alignments(program: Path, clouds: tuple[Points, Points], leaf: float) -> None:
    target, source = clouds
    settings = Settings("pcl", epsilon=1e-6, max_iterations=35)
    with PclNdt(program, target, source, leaf) as pcl, NdtMatcher(settings) as matcher:
        matcher.set_map(VoxelMap({"map": voxel_cell(target, leaf)}))
        for pose in TRUTH + (poses(leaf, 5) - TRUTH) / 4:
            theirs = pcl.align(pose, 1e-6, 35)
            ours = matcher.align(source, matrix_from_pose(pose))
            assert ours.iterations == theirs.iterations
            np.testing.assert_allclose(ours.T_map_base[:3, 3], theirs.T[:3, 3], atol=1e-4)
            np.testing.assert_allclose(ours.T_map_base[:3, :3], theirs.T[:3, :3], atol=1e-5)
            assert ours.transform_probability == pytest.approx(theirs.score_per_point, abs=1e-4)

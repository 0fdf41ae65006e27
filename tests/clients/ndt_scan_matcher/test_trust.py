# SPDX-License-Identifier: Apache-2.0
"""Which results are trusted, at any leaf size; and when a vehicle is lost."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from shmmap_clients.ndt_scan_matcher import (
    NdtMatcher,
    Result,
    Settings,
    TrustLimits,
    matrix_from_pose,
)
from shmmap_clients.ndt_scan_matcher.drive.follower import Tracking
from shmmap_clients.ndt_scan_matcher.matching.result import Evidence, default_nvtl

import shmmap
from tests.clients.ndt_scan_matcher.scene import map_of, scan_from, street

TRUTH = np.array([1.0, -0.5, 1.8, 0.0, 0.0, 0.2])
BESIDE = np.array([1.2, -0.6, 1.85, 0.0, 0.0, 0.21])
EVIDENCE = Evidence(points=1000, distance=40.0, angle=280.0, sharpness=8.0, spread=0.2)
REST = ("points", "distance", "angle", "sharpness", "spread")
GOOD = {
    "no_map": False,
    "converged": True,
    "nvtl": 3.0,
    "transform_probability": 5.0,
    "oscillations": 0,
    "evidence": EVIDENCE,
}


def aligned(points: NDArray[np.float64], leaf: float) -> Result:
    """Align a scan of the street from beside its pose."""
    with NdtMatcher(Settings(steady=True)) as matcher:
        matcher.set_map(map_of(points, leaf))
        return matcher.align(scan_from(street(5), TRUTH, 1500), matrix_from_pose(BESIDE))


@pytest.mark.parametrize(("leaf", "nvtl"), [(1.0, 1.215), (2.0, 2.3), (3.0, 2.96)])
def test_the_default_grows_with_the_leaf(leaf: float, nvtl: float) -> None:
    assert default_nvtl(leaf) == pytest.approx(nvtl, abs=0.01)
    assert TrustLimits().for_leaf(leaf).nvtl == default_nvtl(leaf)
    assert TrustLimits(nvtl=0.7).for_leaf(leaf).nvtl == 0.7


def test_true_covariances_score_lower_at_a_small_leaf() -> None:
    assert default_nvtl(1.0, fine=True) == pytest.approx(0.91, abs=0.01)
    assert default_nvtl(2.0, fine=True) == default_nvtl(2.0)
    assert default_nvtl(1.0, fine=True) < default_nvtl(1.5, fine=True) < default_nvtl(1.5)


@pytest.mark.parametrize("leaf", [1.0, 2.0, 3.0])
def test_a_right_pose_is_trusted_at_any_leaf(points: NDArray[np.float64], leaf: float) -> None:
    right = aligned(points, leaf)
    assert np.linalg.norm(right.T_map_base[:3, 3] - TRUTH[:3]) < 0.1
    assert right.trustworthy
    assert right.failed_limits == ()
    assert not right.no_map


@pytest.mark.parametrize(
    ("change", "failed"),
    [
        ({}, ()),
        ({"converged": False}, ("converged",)),
        ({"nvtl": 2.2}, ("nvtl",)),
        ({"transform_probability": 3.9}, ("transform_probability",)),
        ({"oscillations": 11}, ("oscillations",)),
        ({"oscillations": 10, "nvtl": 2.3, "transform_probability": 4.0}, ()),
        ({"no_map": True, "converged": False, "nvtl": 0.0}, ("no_map",)),
        ({"evidence": replace(EVIDENCE, points=79)}, ("points",)),
        ({"evidence": replace(EVIDENCE, distance=9.9)}, ("distance",)),
        ({"evidence": replace(EVIDENCE, sharpness=2.6)}, ("sharpness",)),
        ({"evidence": replace(EVIDENCE, spread=0.02)}, ("spread",)),
        ({"evidence": Evidence(80, 10.0, 35.0, 2.7, 0.03)}, ()),
        ({"evidence": replace(EVIDENCE, angle=34.0)}, ("angle",)),
        ({"evidence": Evidence(1, 0.0, 0.0, np.nan, np.nan)}, REST),
    ],
)
def test_every_limit_counts(change: dict[str, Any], failed: tuple[str, ...]) -> None:
    limits = TrustLimits(nvtl=2.3, transform_probability=4.0).for_leaf(2.0)
    result: dict[str, Any] = GOOD | change
    assert limits.failed(**result) == failed
    assert all(limits.describe(name) for name in failed)


def test_limits_that_make_no_sense_are_refused() -> None:
    refused: list[dict[str, Any]] = [
        {"nvtl": -1.0},
        {"transform_probability": float("nan")},
        {"oscillations": -1},
        {"points": -1},
        {"distance": float("nan")},
        {"sharpness": -0.1},
        {"spread": -0.1},
        {"angle": -1.0},
    ]
    for wrong in refused:
        with pytest.raises(shmmap.BadRequest, match="limit of trust"):
            TrustLimits(**wrong)
    with pytest.raises(shmmap.BadRequest, match="lost_after"):
        Tracking(0)


def test_a_vehicle_is_lost_after_the_given_number_of_results(points: NDArray[np.float64]) -> None:
    trusted = aligned(points, 2.0)
    untrusted = replace(trusted, failed_limits=("nvtl",))
    nowhere = replace(trusted, failed_limits=("no_map",), no_map=True)
    tracking = Tracking(3)
    assert tracking.state == "uncertain"
    states = [tracking.update(one) for one in (trusted, untrusted, untrusted, trusted)]
    assert states == ["tracking", "uncertain", "uncertain", "tracking"], (
        "a trusted one starts the count again"
    )
    states = [tracking.update(one) for one in (untrusted, untrusted, untrusted, untrusted, trusted)]
    assert states == ["uncertain", "uncertain", "lost", "lost", "tracking"]
    assert tracking.update(nowhere) == "lost", "there is nothing to wait for"
    assert Tracking(3, lost=True).update(untrusted) == "lost"

# SPDX-License-Identifier: Apache-2.0
"""The search for initial poses: candidates, rough poses, what is refused."""

from __future__ import annotations

import math

import numpy as np
import pytest
from shmmap_clients.pose_initializer import InitializerRules, RoughPose
from shmmap_clients.pose_initializer.candidates import ParzenEstimator

import shmmap


def test_candidates_have_the_rough_poses_spread() -> None:
    rough = RoughPose(10.0, -5.0, yaw=3.0, sigma_m=2.0, sigma_yaw=0.1)
    drawn = ParzenEstimator(rough).first(4000)
    np.testing.assert_array_equal(drawn[0], [10.0, -5.0, 3.0])
    np.testing.assert_allclose(drawn.mean(axis=0), [10.0, -5.0, 3.0], atol=0.15)
    np.testing.assert_allclose(drawn.std(axis=0), [2.0, 2.0, 0.1], rtol=0.06)
    matrix = ((4.0, 1.5, 0.0), (1.5, 1.0, 0.0), (0.0, 0.0, 0.04))
    drawn = ParzenEstimator(RoughPose(0.0, 0.0, covariance=matrix)).first(4000)
    np.testing.assert_allclose(np.cov(drawn.T), matrix, atol=0.2)
    everywhere = ParzenEstimator(RoughPose(0.0, 0.0, sigma_yaw=math.pi)).first(4000)[1:, 2]
    assert np.histogram(everywhere, 8, (-math.pi, math.pi))[0].min() > 400


def test_the_estimator_finds_a_peak_and_is_repeatable() -> None:
    peak = np.array([2.5, -1.0, 0.12])

    def score(candidates: np.ndarray) -> np.ndarray:
        return np.asarray(np.exp(-(((candidates - peak) / [1.0, 1.0, 0.1]) ** 2).sum(axis=1)))

    def searched() -> ParzenEstimator:
        estimator = ParzenEstimator(RoughPose(0.0, 0.0, sigma_m=2.0, sigma_yaw=0.2), seed=4)
        batch = estimator.first(100)
        for _ in range(5):
            estimator.learn(batch, score(batch))
            batch = estimator.next(20)
        return estimator

    best = searched().best(3, 0.5, 0.05)
    assert np.abs((best[0] - peak) / [1.0, 1.0, 0.1]).max() < 0.5
    np.testing.assert_array_equal(best, searched().best(3, 0.5, 0.05))
    for one, other in ((0, 1), (0, 2), (1, 2)):
        apart = np.abs(best[one] - best[other])
        assert math.hypot(*apart[:2]) >= 0.5 or apart[2] >= 0.05


def test_headings_are_near_across_half_a_turn() -> None:
    estimator = ParzenEstimator(RoughPose(0.0, 0.0))
    estimator.learn(np.array([[0.0, 0.0, 3.1], [0.0, 0.0, -3.1], [0.0, 0.0, 0.0]]), np.array([3.0, 2.0, 1.0]))
    np.testing.assert_array_equal(estimator.best(3, 1.0, 0.5)[:, 2], [3.1, 0.0])


@pytest.mark.parametrize(
    "settings",
    [
        {"x": math.nan},
        {"sigma_m": 0.0},
        {"sigma_m": math.inf},
        {"sigma_yaw": -1.0},
        {"covariance": ((1.0, 0.0), (0.0, 1.0))},
        {"covariance": ((1.0, 0.5, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))},
        {"covariance": ((1.0, 2.0, 0.0), (2.0, 1.0, 0.0), (0.0, 0.0, 1.0))},
    ],
)
def test_rough_poses_that_make_no_sense_are_refused(settings: dict[str, object]) -> None:
    with pytest.raises(shmmap.BadRequest):
        RoughPose(**{"x": 0.0, "y": 0.0, **settings})  # type: ignore[arg-type]
    with pytest.raises(shmmap.BadRequest):
        InitializerRules(starts=0)

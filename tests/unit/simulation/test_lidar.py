# SPDX-License-Identifier: Apache-2.0
"""The simulated LiDAR sees what is in front, and the traffic moves."""

from __future__ import annotations

import numpy as np

from shmmap.simulation.lidar import Lidar, Traffic
from shmmap.simulation.town import Town


def test_a_wall_hides_what_is_behind_it() -> None:
    rng = np.random.default_rng(1)
    wall = np.column_stack([np.full(60_000, 10.0), rng.uniform(-5, 5, 60_000), rng.uniform(-2, 4, 60_000)])
    behind = wall * (2, 1, 1)
    behind[:, 1] *= 3
    lidar = Lidar(noise=0.01, dropout=0.0, azimuth_deg=0.5, rings=32)
    T = np.eye(4)
    T[:3, 3] = 1.0, 0.0, 0.5
    seen = lidar.scan(np.concatenate([wall, behind]), T, rng)
    front = seen.source < len(wall)
    angle = np.degrees(np.arctan2(seen.xyz[:, 1], seen.xyz[:, 0]))
    assert front[np.abs(angle) < 25].all()
    assert (~front[np.abs(angle) > 35]).all()
    assert abs(float(np.median(seen.xyz[front, 0])) - 9.0) < 0.01
    assert seen.ring.max() <= 31
    rays = np.unique(np.stack([seen.ring, np.floor(angle / 0.5)]), axis=1).shape[1]
    assert rays > 0.9 * len(seen.xyz)  # one return of a ray, but for noise in its direction


def test_range_and_dropout() -> None:
    cloud = np.array([[1.0, 0, 0], [5.0, 0, 0], [-200.0, 0, 0]])
    lidar = Lidar(dropout=0.0)
    assert lidar.scan(cloud, np.eye(4), np.random.default_rng(1)).source.tolist() == [1]
    none = Lidar(dropout=1.0).scan(cloud, np.eye(4), np.random.default_rng(1))
    assert none.xyz.shape == (0, 3)


def test_traffic_moves_on_the_streets() -> None:
    town = Town(seed=2, blocks=(3, 3))
    traffic = Traffic(town, town.route(length=80.0))
    now, later = traffic.points(0.0), traffic.points(1.0)
    assert len(now) > 1000
    assert not np.array_equal(now[:50], later[:50])
    height = now[:, 2] - town.ground_height(now[:, 0], now[:, 1])
    assert -0.4 < height.min() < height.max() < 2.5
    assert np.array_equal(now, Traffic(town, town.route(length=80.0)).points(0.0))

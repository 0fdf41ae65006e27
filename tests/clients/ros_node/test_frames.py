# SPDX-License-Identifier: Apache-2.0
"""Where a frame is in another one, by transforms as ``/tf`` brings them."""

from __future__ import annotations

import itertools
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from shmmap_clients.ros_node.frames import Frames


def transform(parent: str, child: str, rotation: Rotation, translation: Any) -> Any:
    """A ``geometry_msgs/TransformStamped``."""
    quaternion = dict(zip("xyzw", rotation.as_quat().tolist(), strict=True))
    moved = dict(zip("xyz", map(float, translation), strict=True))
    return SimpleNamespace(
        header=SimpleNamespace(frame_id=parent),
        child_frame_id=child,
        transform=SimpleNamespace(
            rotation=SimpleNamespace(**quaternion), translation=SimpleNamespace(**moved)
        ),
    )


@pytest.mark.parametrize("seed", range(20))
def test_a_chain_of_transforms(seed: int) -> None:
    random = np.random.default_rng(seed)
    names = ["map", "odom", "base_link", "lidar"]
    place = np.zeros(3)
    steps: list[Any] = []
    for parent, child in itertools.pairwise(names):
        rotation = Rotation.random(random_state=seed + len(steps))
        steps.append(transform(parent, child, rotation, random.normal(size=3) * 100))
    frames = Frames()
    for one in random.permutation(len(steps)):
        frames.add([steps[one]])
    for one in reversed(steps):
        q, t = one.transform.rotation, one.transform.translation
        place = Rotation.from_quat([q.x, q.y, q.z, q.w]).apply(place) + np.array([t.x, t.y, t.z])
    assert frames.origin_of("lidar", "map") == pytest.approx(tuple(place), abs=1e-9)


def test_the_last_transform_counts() -> None:
    frames = Frames()
    none = Rotation.identity()
    frames.add(
        [transform("map", "base_link", none, (1, 2, 3)), transform("map", "base_link", none, (4, 5, 6))]
    )
    assert frames.origin_of("base_link", "map") == (4.0, 5.0, 6.0)
    assert frames.origin_of("map", "map") == (0.0, 0.0, 0.0)


def test_what_leads_nowhere() -> None:
    frames = Frames()
    none = Rotation.identity()
    frames.add([transform("odom", "base_link", none, (1, 2, 3))])
    assert frames.origin_of("base_link", "map") is None
    frames.add([transform("base_link", "odom", none, (1, 2, 3))])
    assert frames.origin_of("base_link", "map") is None, "a ring"
    frames.add([transform("map", "odom", none, (float("nan"), 0, 0))])
    assert frames.origin_of("base_link", "map") is None

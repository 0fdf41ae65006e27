# SPDX-License-Identifier: Apache-2.0
"""Transforms between frames at a time, of ``/tf`` and ``/tf_static``."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from shmmap_clients.scans.frames import MovingFrames, StaticFrames
from shmmap_clients.scans.trajectory import matrix_of, quaternion_of

from shmmap import MapDataError

TURNED = matrix_of((1.0, 2.0, 3.0), (0.0, 0.0, 0.6, 0.8))


def edge(parent: str, child: str, T: NDArray[np.float64], stamp_s: float = 0.0) -> Any:
    """A ``geometry_msgs/TransformStamped``."""
    stamp = SimpleNamespace(sec=int(stamp_s), nanosec=round(stamp_s % 1 * 1e9))
    return SimpleNamespace(
        header=SimpleNamespace(frame_id=parent, stamp=stamp),
        child_frame_id=child,
        transform=SimpleNamespace(
            translation=SimpleNamespace(**dict(zip("xyz", T[:3, 3], strict=True))),
            rotation=SimpleNamespace(**dict(zip("xyzw", quaternion_of(T[:3, :3]), strict=True))),
        ),
    )


def along(x: float) -> NDArray[np.float64]:
    return matrix_of((x, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


@pytest.fixture
def frames() -> MovingFrames:
    """odom to base_footprint moves by 10 m/s, base_footprint to base_link is fixed."""
    static = StaticFrames("here")
    static.add([edge("base_footprint", "base_link", TURNED)])
    moving = MovingFrames(static, "here")
    for n in range(5):
        moving.add([edge("/odom", "/base_footprint", along(n), 10.0 + 0.1 * n)])
    return moving


def test_a_chain_of_both(frames: MovingFrames) -> None:
    assert frames.leads("odom", "base_link")
    assert not frames.leads("map", "base_link")
    for stamp_s, x in ((10.0, 0.0), (10.25, 2.5), (10.4, 4.0)):
        found = frames.at(stamp_s, "odom", "base_link")
        assert found is not None
        np.testing.assert_allclose(found, along(x) @ TURNED, atol=1e-6)


def test_times_that_are_not_there(frames: MovingFrames) -> None:
    assert frames.at(9.9, "odom", "base_link") is None
    assert frames.at(10.41, "odom", "base_link") is None, "it may come yet"
    frames.add([edge("odom", "base_footprint", along(9), 12.1)])
    assert frames.at(11.0, "odom", "base_link") is None, "a gap"
    assert frames.at(12.1, "odom", "base_link") is not None
    assert frames.at(12.1, "map", "base_link") is None


def test_a_clock_that_is_set_back(frames: MovingFrames) -> None:
    frames.add([edge("odom", "base_footprint", along(7), 3.0)])
    assert frames.at(10.2, "odom", "base_link") is None
    assert frames.at(3.0, "odom", "base_link") is not None


def test_no_transform(frames: MovingFrames) -> None:
    bad = edge("odom", "base_footprint", along(0), 11.0)
    bad.transform.rotation = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=0.0)
    frames.add([bad])
    with pytest.raises(MapDataError, match="here, /tf: the quaternion"):
        frames.at(11.0, "odom", "base_link")


def test_a_circle() -> None:
    static = StaticFrames("here")
    static.add([edge("a", "b", TURNED), edge("b", "a", TURNED)])
    moving = MovingFrames(static, "here")
    assert not moving.leads("odom", "a")
    assert moving.at(0.0, "odom", "a") is None

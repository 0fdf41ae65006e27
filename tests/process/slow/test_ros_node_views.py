# SPDX-License-Identifier: Apache-2.0
"""What the node shows in RViz: the map around the vehicle, cells by state, and a live map."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import shmmap
from tests.support.daemon_process import DaemonProcess, until
from tests.support.live_drive import FILTER, drive
from tests.support.live_reference import LiveDaemon
from tests.support.ros.processes import NODE, RosDomain, RosPeer

CLOUD = "sensor_msgs/msg/PointCloud2"
MARKERS = "visualization_msgs/msg/MarkerArray"
LEAF = 2.0
RADIUS = 15.0
SETTINGS = ("-p", f"around.radius:={RADIUS}", "-p", f"around.leaf_size:={LEAF}")
LIVE = "/shmmap/live"


@pytest.fixture
def peer(domain: RosDomain) -> RosPeer:
    """A process with a ROS node."""
    return domain.peer()


def points_of(message: dict[str, Any]) -> NDArray[np.float32]:
    """The points of a cloud, (N, 3), sorted."""
    rows = np.frombuffer(message["data"], np.uint8).reshape(-1, message["point_step"] or 1)
    assert [one["name"] for one in message["fields"][:3]] == ["x", "y", "z"]
    return _sorted(np.ascontiguousarray(rows[:, :12]).view(np.float32))


def _sorted(xyz: NDArray[np.float32]) -> NDArray[np.float32]:
    return xyz[np.lexsort(xyz.T)]


def around(daemon: DaemonProcess, x: float, y: float) -> NDArray[np.float32]:
    """What the daemon has there, as float32, sorted."""
    with shmmap.connect(daemon.endpoint) as client:
        cells = client.around(x, y, RADIUS, layers=f"voxel(leaf={LEAF})", wait=math.inf, strict=True)
        assert len(cells) > 1
        return _sorted(
            np.concatenate([(cell.xyz + np.array(cell.origin)).astype(np.float32) for cell in cells])
        )


def moved(parent: str, child: str, **transform: Any) -> dict[str, Any]:
    """A message with one transform."""
    return {"transforms": [{"header": {"frame_id": parent}, "child_frame_id": child, "transform": transform}]}


def at(x: float, y: float) -> dict[str, Any]:
    """``/tf`` of a vehicle there: odom to base_link, where odom is turned by a right angle, 5 m along x."""
    return moved("odom", "base_link", translation={"x": y, "y": 5.0 - x, "z": 1.0}, rotation={"w": 1.0})


def sessions(daemon: DaemonProcess) -> list[str]:
    """Names of the daemon's clients."""
    with shmmap.connect(daemon.endpoint) as client:
        return [one.client for one in client.stats().sessions]


def arrives(topic: Any, fits: Callable[[Any], bool]) -> Any:
    """Return the first message that fits: a cloud may come in parts while cells load."""
    while not fits(message := topic.next()):
        pass
    return message


def test_the_map_around_a_vehicle(domain: RosDomain, peer: RosPeer, served: DaemonProcess) -> None:
    """By its transforms, while there are subscribers; a late subscriber gets the last one."""
    domain.node(served, *SETTINGS)
    odom = {"translation": {"x": 5.0}, "rotation": {"z": math.sqrt(0.5), "w": math.sqrt(0.5)}}
    peer.advertised("tf2_msgs/msg/TFMessage", "/tf_static", latched=True).send(**moved("map", "odom", **odom))
    tf = peer.advertised("tf2_msgs/msg/TFMessage", "/tf")
    tf.repeat(**at(3.0, -4.0))
    assert not [name for name in sessions(served) if "around" in name]
    seen = peer.subscribed(CLOUD, f"{NODE}/around")
    here = around(served, 3.0, -4.0)
    message = arrives(seen, lambda one: np.array_equal(points_of(one), here))
    assert message["header"]["frame_id"] == "map"
    there = around(served, 33.0, 16.0)
    assert not np.array_equal(here, there)
    tf.repeat(**at(33.0, 16.0))
    arrives(seen, lambda one: np.array_equal(points_of(one), there))
    late = peer.subscribed(CLOUD, f"{NODE}/around")
    assert np.array_equal(points_of(late.next()), there)
    assert [name for name in sessions(served) if "around" in name]
    seen.end()
    late.end()
    until(lambda: not [name for name in sessions(served) if "around" in name])


def test_a_pose_and_cells_by_state(domain: RosDomain, peer: RosPeer, served: DaemonProcess) -> None:
    """The vehicle's place as a pose, in the map's frame alone; boxes of what is attached there."""
    node = domain.node(served, *SETTINGS, "-p", "around.leaf_size:=0.0")
    poses = peer.advertised("geometry_msgs/msg/PoseStamped", f"{NODE}/pose")
    boxes = peer.subscribed(MARKERS, f"{NODE}/cells")
    place = {"position": {"x": 3.0, "y": -4.0, "z": 0.0}}
    poses.repeat(header={"frame_id": "odom"}, pose=place)
    until(lambda: "~/pose is in frame odom" in node.log, lambda: node.log)
    poses.repeat(header={"frame_id": "map"}, pose=place)
    with shmmap.connect(served.endpoint) as client:
        near, all_of_them = len(client.around(3.0, -4.0, RADIUS, wait=math.inf)), len(client.metadata())

    def drawn(message: Any) -> dict[str, int]:
        return {one["ns"]: len(one["points"]) for one in message["markers"]}

    message = arrives(boxes, lambda one: drawn(one)["attached"] == 24 * near)
    assert 0 < near < all_of_them
    assert drawn(message)["loading"] == drawn(message)["failed"] == 0
    assert {one["header"]["frame_id"] for one in message["markers"]} == {"map"}


def test_a_live_map(domain: RosDomain, peer: RosPeer, live_daemon: LiveDaemon) -> None:
    """Its voxels by services and as clouds, its chunks, and the map from above."""
    one = live_daemon()
    with shmmap.connect(one.endpoint) as client, client.live("lidar").mapper("front", FILTER) as sending:
        for points, pose in drive(4):
            sending.add(points, pose)
        sending.wait_durable()
        live = client.live("lidar")
        low, high = 0.0, 3.0
        heights = ("-p", f"projected_map.min_z:={low}", "-p", f"projected_map.max_z:={high}")
        domain.node(one, "-p", "live:=lidar", *heights)
        kinds = {"occupied": "bonxai_msgs/srv/GetOccupiedVoxels", "free": "bonxai_msgs/srv/GetFreeVoxels"}
        known = {kind: live.voxels(kind) for kind in kinds}
        assert all(len(voxels) for voxels in known.values())
        for kind, service in kinds.items():
            expected = sorted(map(tuple, known[kind].indices.tolist()))
            for place in ("", "saved_"):
                reply = peer.client_of(service, f"{LIVE}/get_{place}{kind}_voxels").call()
                grid = reply["voxel_grid"]
                assert reply["success"]
                assert sorted(zip(grid["x"], grid["y"], grid["z"], strict=True)) == expected
                assert reply[f"{kind}_count"] == grid["num_voxels"] == len(expected)
                assert [grid[f"min_{axis}"] for axis in "xyz"] == known[kind].indices.min(axis=0).tolist()
            cloud = peer.subscribed(CLOUD, f"{LIVE}/{kind}_voxels").next()
            assert np.array_equal(points_of(cloud), _sorted(known[kind].xyz.astype(np.float32)))
        chunks = peer.subscribed(MARKERS, f"{LIVE}/chunks").next()
        assert sum(len(one["points"]) for one in chunks["markers"]) == 24 * len(live.chunks(saved=True))
        grid = peer.subscribed("nav_msgs/msg/OccupancyGrid", f"{NODE}/projected_map").next()
        info = grid["info"]
        image = np.array(grid["data"], np.int8).reshape(info["height"], info["width"])
        corner = np.array([info["origin"]["position"][axis] for axis in "xy"])
        for kind, value in (("free", 0), ("occupied", 100)):
            xyz = known[kind].xyz
            xyz = xyz[(xyz[:, 2] >= low) & (xyz[:, 2] <= high)]
            column, row = np.floor((xyz[:, :2] - corner) / live.resolution).astype(int).T
            hidden = {100} if kind == "free" else set()
            assert set(np.unique(image[row, column]).tolist()) <= {value, *hidden}
            assert (image == value).sum() <= len(np.unique(np.stack([column, row], 1), axis=0))
        assert set(np.unique(image).tolist()) == {-1, 0, 100}

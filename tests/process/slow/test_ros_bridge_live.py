# SPDX-License-Identifier: Apache-2.0
"""Voxels of a live map over ROS: Rolling-Bonxai's services, from memory and from disk, and its clouds."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="needs the package cyclonedds")

from shmmap_clients.ros_bridge.messages import FREE, OCCUPIED, PointCloud2

import shmmap
from tests.support.bridge_process import PROGRAM, BridgeProcess, bridge_environment
from tests.support.daemon_process import DaemonProcess, Deadline
from tests.support.live_drive import FILTER, RESOLUTION, drive
from tests.support.live_reference import LiveDaemon
from tests.support.ros_peer import RosPeer

Voxel = tuple[int, int, int]
SERVICES = {"occupied": OCCUPIED, "free": FREE}


@contextmanager
def mapped(one: DaemonProcess, scans: int, *, mapper: str = "front") -> Iterator[None]:
    """Drive through the map, and stay there: chunks around the mapper stay in memory."""
    with shmmap.connect(one.endpoint) as client, client.live("lidar").mapper(mapper, FILTER) as sending:
        for points, pose in drive(scans):
            sending.add(points, pose)
        sending.wait_durable()
        yield


def of_kind(one: DaemonProcess, scope: str) -> dict[str, set[Voxel]]:
    """Voxels as the daemon's own client sees them."""
    with shmmap.connect(one.endpoint) as client:
        live = client.live("lidar")
        return {
            kind: {tuple(voxel) for voxel in live.voxels(kind, scope=scope).indices.tolist()}
            for kind in SERVICES
        }


def voxels(reply: Any) -> set[Voxel]:
    grid = reply.voxel_grid
    found = set(zip(grid.x, grid.y, grid.z, strict=True))
    assert len(found) == grid.num_voxels == len(grid.x), "none comes twice"
    return found


def test_services_give_every_voxel(live_daemon: LiveDaemon, dds: int, peer: RosPeer) -> None:
    one = live_daemon()
    with BridgeProcess(one, dds) as bridge:
        bridge.wait_said("live map lidar")
        empty = peer.client("/shmmap/live/get_occupied_voxels", OCCUPIED)
        assert voxels(empty.call(structure_needs_at_least_one_member=0)) == set()
        with mapped(one, 8):
            for scope, prefix in (("memory", "get"), ("disk", "get_saved")):
                for kind, service in SERVICES.items():
                    client = peer.client(f"/shmmap/live/{prefix}_{kind}_voxels", service)
                    there, reply, now = of_kind(one, scope), None, None
                    waiting = Deadline()
                    while waiting(reply is None or there != now):  # chunks leave memory, too
                        there = of_kind(one, scope)
                        reply = client.call(structure_needs_at_least_one_member=0)
                        now = of_kind(one, scope)
                    assert min(map(len, there.values())) > 100
                    check_reply(reply, there, kind)


def check_reply(reply: Any, there: dict[str, set[Voxel]], kind: str) -> None:
    assert voxels(reply) == there[kind]
    grid = reply.voxel_grid
    assert (grid.header.frame_id, grid.resolution) == ("map", RESOLUTION)
    assert grid.header.stamp.sec > 0
    axes = list(zip(*there[kind], strict=True))
    box = (grid.min_x, grid.min_y, grid.min_z, grid.max_x, grid.max_y, grid.max_z)
    assert box == (*map(min, axes), *map(max, axes))
    assert getattr(reply, f"{kind}_count") == len(there[kind])
    assert reply.success
    assert reply.total_active_cells >= len(there["occupied"]) + len(there["free"])
    assert 0 < reply.occupancy_ratio < 1
    assert reply.memory_mb > 0


def in_cloud(cloud: Any) -> set[Voxel]:
    assert (cloud.header.frame_id, cloud.point_step, cloud.height) == ("map", 12, 1)
    assert [field.name for field in cloud.fields] == ["x", "y", "z"]
    middles = np.frombuffer(bytes(cloud.data), "<f4").reshape(-1, 3)
    assert len(middles) == cloud.width
    return {tuple(voxel) for voxel in np.floor(middles / RESOLUTION).astype(int).tolist()}


def test_clouds_follow_the_map(live_daemon: LiveDaemon, dds: int, peer: RosPeer) -> None:
    """A listener receives what is there, again when it has changed; after a restart of the daemon, too."""
    one = live_daemon()
    with BridgeProcess(one, dds, "--voxels-every", "0.1", "--name", "live=/lidar"):
        for mapper in ("first", "second"):
            clouds_by_kind = {
                kind: peer.following(f"/lidar/{kind}_voxels", PointCloud2, latched=False) for kind in SERVICES
            }
            with mapped(one, 3, mapper=mapper):
                for kind, clouds in clouds_by_kind.items():
                    assert any(
                        found and found == of_kind(one, "memory")[kind] for found in map(in_cloud, clouds)
                    )
                with mapped(one, 5, mapper=f"{mapper} more"):
                    for kind, clouds in clouds_by_kind.items():
                        assert any(found == of_kind(one, "memory")[kind] for found in map(in_cloud, clouds))
            one.kill()
            one.start()


def test_which_live_map(live_daemon: LiveDaemon, dds: int) -> None:
    one = live_daemon("--live", "roof", start=False)
    one.environment["XDG_STATE_HOME"] = one.scratch_dir
    one.start()
    words = [*PROGRAM, "--endpoint", one.endpoint, "--domain", str(dds)]
    environment = bridge_environment()
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, env=environment)
    assert done.returncode == 2
    assert "several live maps: lidar, roof" in done.stderr
    words += ["--live", "floor"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, env=environment)
    assert done.returncode == 2
    with BridgeProcess(one, dds, "--live", "roof") as bridge:
        bridge.wait_said("live map roof")

# SPDX-License-Identifier: Apache-2.0
"""Autoware's three map services, asked by a peer of the package `cyclonedds`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from shmmap_clients.ros_bridge.messages import DIFFERENTIAL, PARTIAL, SELECTED, AreaInfo

import shmmap
from tests.support.daemon_process import DaemonProcess
from tests.support.ros_peer import RosPeer
from tests.support.ros_reply import Reply, from_message

__all__ = ["KINDS", "NAMES", "asked", "reload"]

NAMES = {
    "partial": "/map/get_partial_pointcloud_map",
    "differential": "/map/get_differential_pointcloud_map",
    "selected": "/map/get_selected_pointcloud_map",
}
KINDS = {"partial": PARTIAL, "differential": DIFFERENTIAL, "selected": SELECTED}


def asked(peer: RosPeer, verb: str, *, area: Sequence[float] = (), ids: Sequence[str] = ()) -> Reply:
    """Ask a service as a client of its own."""
    client = peer.client(NAMES[verb], KINDS[verb])
    fields: dict[str, Any] = {"area": AreaInfo(*area)} if area else {}
    if verb == "differential":
        fields["cached_ids"] = list(ids)
    elif verb == "selected":
        fields["cell_ids"] = list(ids)
    found = from_message(client.call(**fields))
    client.close()
    return found


def reload(one: DaemonProcess) -> None:
    """Have the daemon read its map again."""
    with shmmap.connect(one.endpoint) as client:
        client.reload()

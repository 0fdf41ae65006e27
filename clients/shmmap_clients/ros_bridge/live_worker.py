# SPDX-License-Identifier: Apache-2.0
"""Services and topics of a live map: the thread that asks the daemon for voxels."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final

import numpy as np
from cyclonedds.pub import DataWriter

from shmmap.live import LiveMap
from shmmap_clients.rolling_map.live_map import all_voxels
from shmmap_clients.ros_bridge.cdr import CdrWriter, Content, copy_into, write_cloud
from shmmap_clients.ros_bridge.messages import FREE, OCCUPIED, PointCloud2, ServiceKind, ready_made
from shmmap_clients.ros_bridge.service_server import Listening, Request
from shmmap_clients.ros_bridge.worker import Worker
from shmmap_clients.ros_cells.live_voxels import SEARCHES, LostChunks, VoxelList, list_voxels

_KINDS: Final = {"occupied": OCCUPIED, "free": FREE}
LIVE_SERVICES: Final[Mapping[str, ServiceKind]] = {
    name: _KINDS[kind] for name, (kind, _scope) in SEARCHES.items()
}
"""Types by the last part of the service's name."""


def _voxel_reply(live: LiveMap, message: Any, kind: str, scope: str, *, success: bool) -> Content:
    """Return a reply with all voxels of a kind.

    Raises
    ------
    ShmmapError
        The daemon does not answer, or has no memory for a list.
    """
    found = list_voxels(live, kind, scope)
    writer = _head(live, message, found)
    writer.numbers("QQff?", len(found.indices), found.active, found.ratio, found.memory_mb, success)
    return writer.content()


def _failed_reply(message: Any) -> Content:
    """Return a reply without voxels that reports failure."""
    writer = _head(None, message, VoxelList(np.empty((0, 3), np.int32), 0, 0.0, 0.0))
    writer.numbers("QQff?", 0, 0, 0.0, 0.0, False)
    return writer.content()


def _head(live: LiveMap | None, message: Any, found: VoxelList) -> CdrWriter:
    """Write a reply up to the end of its ``bonxai_msgs/VoxelGrid``."""
    writer = CdrWriter()
    now_ns = time.time_ns() if live is not None else 0
    writer.numbers("QqiI", message.client, message.number, now_ns // 10**9, now_ns % 10**9)
    writer.text(live.frame_id if live is not None else "")
    writer.numbers("d", live.resolution if live is not None else 0.0)
    for values in np.ascontiguousarray(found.indices.T):
        writer.numbers("I", len(values))
        writer.blob(values.nbytes, partial(copy_into, data=values.view(np.uint8).data))
    low, high = found.bounds
    writer.numbers("Iiiiiii", len(found.indices), *low, *high)
    return writer


def _voxel_cloud(live: LiveMap, kind: str) -> Content:
    """Return the centres of all voxels of a kind in memory as a ``PointCloud2``, in the map's frame.

    Raises
    ------
    ShmmapError
        The daemon does not answer, or has no memory for a list.
    """
    writer = CdrWriter()
    write_cloud(writer, {"xyz": all_voxels(live, kind)}, (0.0, 0.0, 0.0), live.frame_id, time.time_ns())
    return writer.content()


class LiveWorker(Worker):
    """Worker that answers with voxels, and publishes changed ones while a node subscribes.

    Parameters
    ----------
    live
        The live map, on a client that only this worker uses.
    clouds
        Writers of the two topics by kind of voxels, ``occupied`` and ``free``.
    listening
        Source of requests.
    every_s
        Interval of checks whether to publish, seconds.
    """

    def __init__(
        self,
        live: LiveMap,
        clouds: Mapping[str, DataWriter],
        listening: Listening,
        *,
        every_s: float,
        stop: threading.Event,
        log: Callable[[str], None],
    ) -> None:
        super().__init__(listening, stop, every_s, log)
        self._live = live
        self._clouds = clouds
        self._published: dict[str, tuple[int, frozenset[int]]] = {}
        self._lost = LostChunks(log)

    def answer(self, message: Any, request: Request) -> Content:
        """Return a reply with voxels; ``success`` is false if something that was saved is lost."""
        kind, scope = SEARCHES[request.server.name.rpartition("/")[2]]
        success = not self._lost.any_of(self._live)
        return _voxel_reply(self._live, message, kind, scope, success=success)

    def empty(self, message: Any) -> Content:
        """Return a reply without voxels."""
        return _failed_reply(message)

    def tick(self) -> None:
        """Publish changed voxels, and all voxels for a new subscriber."""
        for kind, writer in self._clouds.items():
            readers = frozenset(writer.get_matched_subscriptions())
            change = self._live.status().change if readers else 0
            before, had = self._published.get(kind, (-1, frozenset()))
            if readers and (change != before or readers - had):
                self._lost.any_of(self._live)
                writer.write(ready_made(PointCloud2, _voxel_cloud(self._live, kind)))
            self._published[kind] = (change if readers else -1, readers)

# SPDX-License-Identifier: Apache-2.0
"""Services and topics of a live map: the thread that asks the daemon for voxels.

Rolling-Bonxai planned a service for voxels in memory and one for saved chunks; ``bonxai_msgs`` has the types.
Both programs use the same indices of voxels: ``floor(position / resolution)``.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final

import numpy as np
from cyclonedds.pub import DataWriter
from numpy.typing import NDArray

from shmmap.live import LiveMap
from shmmap_clients.rolling_map.live_map import all_voxels
from shmmap_clients.ros_bridge.cdr import CdrWriter, Content, copy_into
from shmmap_clients.ros_bridge.messages import FREE, OCCUPIED, PointCloud2, ServiceKind, ready_made
from shmmap_clients.ros_bridge.point_cloud import write_cloud
from shmmap_clients.ros_bridge.service_server import Listening, Request
from shmmap_clients.ros_bridge.worker import Answer, Worker, no_followup

__all__ = ["LIVE_SERVICES", "LiveWorker"]

LIVE_SERVICES: Final[dict[str, tuple[ServiceKind, str, str]]] = {
    "get_occupied_voxels": (OCCUPIED, "occupied", "memory"),
    "get_free_voxels": (FREE, "free", "memory"),
    "get_saved_occupied_voxels": (OCCUPIED, "occupied", "disk"),
    "get_saved_free_voxels": (FREE, "free", "disk"),
}
"""Types, kind of voxels and place of the search, by the last part of the service's name."""


def _voxel_reply(live: LiveMap, message: Any, kind: str, scope: str) -> Content:
    """Return a reply with all voxels of a kind.

    The counts are from the daemon's list of chunks. For ``disk`` they include every chunk, and chunks in
    memory with their state there. ``memory_mb`` is the size of the map in memory, or of its files, in MiB.
    ``success`` is false if something that was saved is lost of any chunk.

    Raises
    ------
    ShmmapError
        The daemon does not answer, or has no memory for a list.
    """
    rows = live.chunks(saved=scope == "disk")
    occupied, free = (sum(getattr(row, name) for row in rows) for name in ("occupied", "free"))
    status = live.status()
    xyz = all_voxels(live, kind, scope)
    indices = np.floor(xyz / live.resolution).astype(np.int32)
    writer = _head(live, message, indices)
    count = len(indices)
    active = sum(row.active for row in rows)
    ratio = occupied / (occupied + free) if occupied + free else 0.0
    taken = status.file_bytes if scope == "disk" else status.bytes
    writer.numbers("QQff?", count, active, ratio, taken / 2**20, not live.lost())
    return writer.content()


def _failed_reply(message: Any) -> Content:
    """Return a reply without voxels that reports failure."""
    writer = _head(None, message, np.empty((0, 3), np.int32))
    writer.numbers("QQff?", 0, 0, 0.0, 0.0, False)
    return writer.content()


def _head(live: LiveMap | None, message: Any, indices: NDArray[np.int32]) -> CdrWriter:
    """Write a reply up to the end of its ``bonxai_msgs/VoxelGrid``."""
    writer = CdrWriter()
    now_ns = time.time_ns() if live is not None else 0
    writer.numbers("QqiI", message.client, message.number, now_ns // 10**9, now_ns % 10**9)
    writer.text(live.frame_id if live is not None else "")
    writer.numbers("d", live.resolution if live is not None else 0.0)
    for values in np.ascontiguousarray(indices.T):
        writer.numbers("I", len(values))
        writer.blob(values.nbytes, partial(copy_into, data=values.view(np.uint8).data))
    low, high = (indices.min(axis=0), indices.max(axis=0)) if len(indices) else ((0, 0, 0), (0, 0, 0))
    writer.numbers("Iiiiiii", len(indices), *low, *high)
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
        self._lost: frozenset[str] = frozenset()

    def answer(self, message: Any, request: Request) -> Answer:
        """Return a reply with voxels."""
        _, kind, scope = LIVE_SERVICES[request.server.name.rpartition("/")[2]]
        reply = _voxel_reply(self._live, message, kind, scope)
        self._report_lost()
        return reply, no_followup

    def _report_lost(self) -> None:
        """Log chunks of which something is lost, once each."""
        lost = frozenset(f"{key.text}: {reason}" for key, reason in self._live.lost().items())
        if new := lost - self._lost:
            self._log(f"live map {self._live.name} has lost something of chunks: {'; '.join(sorted(new))}")
        self._lost = lost

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
                self._report_lost()
                writer.write(ready_made(PointCloud2, _voxel_cloud(self._live, kind)))
            self._published[kind] = (change if readers else -1, readers)

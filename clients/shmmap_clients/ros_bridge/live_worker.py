# SPDX-License-Identifier: Apache-2.0
"""Services and topics of a live map: the thread that asks the daemon for voxels."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Any

from cyclonedds.pub import DataWriter

from shmmap import LiveMap
from shmmap_clients.ros_bridge.cdr import Content
from shmmap_clients.ros_bridge.listening import Listening
from shmmap_clients.ros_bridge.live_voxels import LIVE_SERVICES, failed_reply, voxel_cloud, voxel_reply
from shmmap_clients.ros_bridge.messages.standard import PointCloud2
from shmmap_clients.ros_bridge.messages.wire import ready_made
from shmmap_clients.ros_bridge.service_server import Request
from shmmap_clients.ros_bridge.worker import Answer, Worker

__all__ = ["LiveWorker"]


class LiveWorker(Worker):
    """Answers with voxels, and publishes them where somebody listens and something has changed.

    Parameters
    ----------
    live
        The map, of a client that nobody else uses.
    clouds
        Writers of the two topics by kind of voxels, ``occupied`` and ``free``.
    listening
        Where requests come.
    every_s
        How often it is looked whether to publish.
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

    def answer(self, message: Any, request: Request) -> Answer:
        """Return a reply with voxels."""
        _, kind, scope = LIVE_SERVICES[request.server.name.rpartition("/")[2]]
        return voxel_reply(self._live, message, kind, scope), _nothing

    def empty(self, message: Any) -> Content:
        """Return a reply without voxels."""
        return failed_reply(message)

    def tick(self) -> None:
        """Publish what has changed, or what somebody has come to hear."""
        for kind, writer in self._clouds.items():
            readers = frozenset(writer.get_matched_subscriptions())
            change = self._live.status().change if readers else 0
            before, had = self._published.get(kind, (-1, frozenset()))
            if readers and (change != before or readers - had):
                writer.write(ready_made(PointCloud2, voxel_cloud(self._live, kind)))
            self._published[kind] = (change if readers else -1, readers)


def _nothing() -> None:
    """Nothing has to be remembered."""

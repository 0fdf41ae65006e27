# SPDX-License-Identifier: Apache-2.0
"""Topics and services that show a live map: its voxels, its chunks, and the map from above.

A topic is made while it has subscribers, whenever the map has changed.  The services are Rolling-Bonxai's,
where ``bonxai_msgs`` is installed.
"""

from __future__ import annotations

import math
import threading
import time
from array import array
from collections import defaultdict
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, Final

import numpy as np
from geometry_msgs.msg import Point
from nav_msgs.msg import OccupancyGrid
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from shmmap import Client, ShmmapError
from shmmap.live import ChunkInfo, LiveMap
from shmmap_clients.rolling_map.live_map import all_voxels
from shmmap_clients.ros_cells import cloud_layout, fill_rows
from shmmap_clients.ros_cells.live_voxels import (
    MAX_CELLS,
    SEARCHES,
    LostChunks,
    VoxelList,
    list_voxels,
    projected,
)
from shmmap_clients.ros_node.lines import add_box, line_markers
from shmmap_clients.ros_node.point_cloud2 import cloud_message

_EVERY_S: Final = 1.0
_SHARE: Final = 0.25
"""Share of the time that making messages may take: after one that took long there is a pause."""
_SIDE: Final = 64  # voxels
_COLOURS: Final[Mapping[str, tuple[float, float, float, float]]] = {
    "clean": (0.2, 0.8, 0.3, 1.0),
    "dirty": (1.0, 0.6, 0.1, 1.0),
    "saving": (0.2, 0.5, 1.0, 1.0),
    "loading": (1.0, 0.8, 0.1, 1.0),
    "saved": (0.5, 0.5, 0.5, 0.4),
}


class LiveTopics:
    """What the node shows of a live map.

    Parameters
    ----------
    node, executor
        The node, and the executor whose thread uses it.
    ended
        Set when the node ends.
    parameters
        The node's.
    connect
        Makes a client.
    ask
        Awaits what a function of a client returns, or an exception: `MapLoader` has the threads for it.
    """

    def __init__(
        self,
        node: Any,
        executor: Any,
        ended: threading.Event,
        parameters: Mapping[str, Any],
        connect: Callable[[], Client],
        ask: Callable[[Callable[[Client, bool], Any]], Awaitable[Any]],
    ) -> None:
        self._node, self._executor, self._ended = node, executor, ended
        self._connect, self._ask, self._warn = connect, ask, node.get_logger().warning
        self._name = parameters["live"]
        self._heights = parameters["projected_map.min_z"], parameters["projected_map.max_z"]
        self._lost = LostChunks(self._warn)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._topics = [
            (node.create_publisher(kind, name, latched), make)
            for kind, name, make in (
                (PointCloud2, "/shmmap/live/occupied_voxels", self._occupied),
                (PointCloud2, "/shmmap/live/free_voxels", self._free),
                (MarkerArray, "/shmmap/live/chunks", self._chunks),
                (OccupancyGrid, "~/projected_map", self._projected),
            )
        ]
        self._serve()
        threading.Thread(target=self._run, daemon=True).start()

    # --- services -------------------------------------------------------------------------------------

    def _serve(self) -> None:
        try:
            from bonxai_msgs.srv import GetFreeVoxels, GetOccupiedVoxels
        except ImportError:
            return  # no node can ask
        kinds = {"occupied": GetOccupiedVoxels, "free": GetFreeVoxels}
        group = ReentrantCallbackGroup()
        for name, (kind, scope) in SEARCHES.items():

            async def answer(_request: Any, reply: Any, kind: str = kind, scope: str = scope) -> Any:
                return await self._answer(reply, kind, scope)

            self._node.create_service(kinds[kind], f"/shmmap/live/{name}", answer, callback_group=group)

    async def _answer(self, reply: Any, kind: str, scope: str) -> Any:
        def work(client: Client, _last: bool) -> tuple[LiveMap, VoxelList, bool]:
            live = client.live(self._name)
            return live, list_voxels(live, kind, scope), not self._lost.any_of(live)

        result = await self._ask(work)
        if isinstance(result, Exception):
            self._warn(f"voxels of live map {self._name}: {result}")
            return reply  # without success
        live, found, reply.success = result
        grid = reply.voxel_grid
        grid.header.frame_id, grid.header.stamp = live.frame_id, self._now()
        grid.resolution, grid.num_voxels = live.resolution, len(found.indices)
        grid.x, grid.y, grid.z = (array("i", column.tobytes()) for column in found.indices.T)
        (grid.min_x, grid.min_y, grid.min_z), (grid.max_x, grid.max_y, grid.max_z) = found.bounds
        setattr(reply, f"{kind}_count", len(found.indices))
        reply.total_active_cells, reply.occupancy_ratio = found.active, found.ratio
        reply.memory_mb = found.memory_mb
        return reply

    # --- topics ---------------------------------------------------------------------------------------

    def _run(self) -> None:
        client: Client | None = None
        live: LiveMap | None = None
        shown: dict[int, int] = {}
        said = ""
        pause_s = _EVERY_S
        while not self._ended.wait(pause_s):
            begin_s = time.monotonic()
            wanted = {
                number: topic
                for number, topic in enumerate(self._topics)
                if topic[0].get_subscription_count()
            }
            shown = {number: shown[number] for number in wanted if number in shown}
            try:
                if wanted:
                    client = client or self._connect()
                    live = live or client.live(self._name)
                    change = live.status().change
                    due = [number for number in wanted if shown.get(number) != change]
                    if due:
                        self._lost.any_of(live)
                    for number in due:
                        publisher, make = wanted[number]
                        message = make(live)
                        if message is not None and not self._ended.is_set():
                            self._executor.create_task(publisher.publish, message)
                        shown[number] = change
                    said = ""
            except ShmmapError as error:
                live = None  # a map of this name may be another one
                if str(error) != said:
                    said = str(error)
                    self._warn(f"live map {self._name} is not shown: {said}")
            pause_s = max(_EVERY_S, (time.monotonic() - begin_s) * (1.0 / _SHARE - 1.0))

    def _now(self) -> Any:
        return self._node.get_clock().now().to_msg()

    def _occupied(self, live: LiveMap) -> PointCloud2:
        return self._cloud(live, "occupied")

    def _free(self, live: LiveMap) -> PointCloud2:
        return self._cloud(live, "free")

    def _cloud(self, live: LiveMap, kind: str) -> PointCloud2:
        columns = {"xyz": all_voxels(live, kind)}
        layout, count = cloud_layout(columns), len(columns["xyz"])
        data = array("B", bytes(count * layout.point_step))
        if count:
            with memoryview(data) as rows:
                fill_rows(rows, columns, (0.0, 0.0, 0.0), layout)
        message = cloud_message(layout, count, data, live.frame_id)
        message.header.stamp = self._now()
        return message

    def _chunks(self, live: LiveMap) -> MarkerArray:
        message = chunks_message(live.chunks(saved=True), live.resolution)
        for marker in message.markers:
            marker.header.frame_id = live.frame_id
        return message

    def _projected(self, live: LiveMap) -> OccupancyGrid | None:
        grid = projected(live, *self._heights)
        if grid is None:
            self._warn(f"~/projected_map: more than {MAX_CELLS:,} cells: not published")
            return None
        message = OccupancyGrid()
        message.header.frame_id, message.header.stamp = live.frame_id, self._now()
        message.info.resolution = grid.resolution
        message.info.height, message.info.width = grid.values.shape
        message.info.origin.position.x, message.info.origin.position.y = grid.x, grid.y
        message.info.origin.position.z = self._heights[0] if math.isfinite(self._heights[0]) else 0.0
        message.data = array("b", grid.values.tobytes())
        return message


def chunks_message(chunks: list[ChunkInfo], resolution: float) -> MarkerArray:
    """Return the boxes of chunks as lines, a marker with its own namespace for each state."""
    lines: defaultdict[str, list[Point]] = defaultdict(list)
    edge = _SIDE * resolution
    for one in chunks:
        low = np.array(one.key) * edge
        add_box(lines[one.state], low.tolist(), (low + edge).tolist())
    return line_markers(lines, _COLOURS)

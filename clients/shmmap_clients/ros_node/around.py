# SPDX-License-Identifier: Apache-2.0
"""Topics that show the map around the vehicle in RViz, Foxglove or Nav2: its points, and its cells by state.

Nothing is asked of the daemon, and ``/tf`` is not read, without a subscriber.  With one a thread of its own
reads it five times a second.  The points are those of a `MapWindow` that follows the vehicle: a message is
published when the window has moved and is whole, or after two seconds with what has come.
"""

from __future__ import annotations

import contextlib
import threading
import time
from array import array
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import islice
from typing import Any, Final

import numpy as np
from geometry_msgs.msg import Point, PoseStamped
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import InvalidHandle
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from shmmap import Cell, CellInfo, MapWindow, ShmmapError
from shmmap_clients.ros_cells.point_cloud import MAX_BYTES, cloud_layout, fill_rows
from shmmap_clients.ros_node.frames import Frames, Place
from shmmap_clients.ros_node.lines import add_box, line_markers
from shmmap_clients.ros_node.point_cloud2 import cloud_message
from shmmap_clients.ros_node.settings import NAME

_LOOK_S: Final = 0.5
_TICK_S: Final = 0.2
_DEPTH: Final = 100  # messages of /tf between two looks: 50 Hz of ten senders
_RETRY_S: Final = 1.0
_INCOMPLETE_S: Final = 2.0
_EVERY_M: Final = 10.0
_MAX_BOXES: Final = 10_000
_BOXES_WITHIN: Final = 4.0
"""Cells as far as this many radii from the vehicle are drawn."""
_COLOURS: Final[Mapping[str, tuple[float, float, float, float]]] = {
    "attached": (0.2, 0.8, 0.3, 1.0),
    "loading": (1.0, 0.8, 0.1, 1.0),
    "failed": (0.9, 0.1, 0.1, 1.0),
    "not attached": (0.5, 0.5, 0.5, 0.4),
}


class Around:
    """The topics ``~/around`` and ``~/cells``, and what they need.

    Parameters
    ----------
    node, executor
        The node, and the executor whose thread uses it.
    ended
        Set when the node ends.
    parameters
        The node's.
    cells
        Returns the map's cells.
    """

    def __init__(
        self,
        node: Any,
        executor: Any,
        ended: threading.Event,
        parameters: Mapping[str, Any],
        cells: Callable[[], Iterable[CellInfo]],
    ) -> None:
        self._node, self._executor, self._ended, self._parameters = node, executor, ended, parameters
        self._cells = cells
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._points = node.create_publisher(PointCloud2, "~/around", latched)
        self._boxes = node.create_publisher(MarkerArray, "~/cells", latched)
        # the thread reads them: each message would wake the executor, for 1 to 2 ms
        self._group = MutuallyExclusiveCallbackGroup()
        self._group.can_execute = lambda _entity: False
        self._subscriptions: list[Any] = []
        self._frames = Frames()
        self._pose: Any = None
        self._said = ""
        self._wanted = threading.Event()
        node.create_timer(_LOOK_S, self._look, clock=Clock(clock_type=ClockType.STEADY_TIME))
        threading.Thread(target=self._run, daemon=True).start()

    # --- in the executor's thread ---------------------------------------------------------------------

    def _look(self) -> None:
        """Follow the vehicle while there are subscribers."""
        wanted = bool(self._points.get_subscription_count() or self._boxes.get_subscription_count())
        if wanted and not self._subscriptions:
            self._follow()
            self._wanted.set()
        elif self._subscriptions and not wanted:
            self._wanted.clear()
            for one in self._subscriptions:
                self._node.destroy_subscription(one)
            self._subscriptions = []
            self._frames, self._pose = Frames(), None

    def _follow(self) -> None:
        subscribe = partial(self._node.create_subscription, callback_group=self._group)
        self._subscriptions = [subscribe(PoseStamped, "~/pose", self._take_pose, 1)]
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            self._say("tf2_msgs is not installed: /tf is not read, give the vehicle's place by ~/pose")
            return
        static = QoSProfile(depth=_DEPTH, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        for name, qos in (("/tf", QoSProfile(depth=_DEPTH)), ("/tf_static", static)):
            self._subscriptions.append(subscribe(TFMessage, name, self._take_frames, qos))

    # --- in the thread --------------------------------------------------------------------------------

    def _read(self) -> None:
        """Take what has come since the last time."""
        for one in tuple(self._subscriptions):
            with contextlib.suppress(InvalidHandle), one.handle:  # the executor's thread may just end it
                for _ in range(_DEPTH):
                    taken = one.handle.take_message(one.msg_type, one.raw)
                    if taken is None:
                        break
                    one.callback(taken[0])

    def _take_frames(self, message: Any) -> None:
        self._frames.add(message.transforms)

    def _take_pose(self, message: Any) -> None:
        self._pose = message

    def _say(self, text: str) -> None:
        """Log a line unless it was the last one."""
        if text != self._said:
            self._said = text
            self._node.get_logger().warning(text)

    def _publish(self, publisher: Any, message: Any) -> None:
        if not self._ended.is_set():
            self._executor.create_task(publisher.publish, message)

    def _run(self) -> None:
        while not self._ended.is_set():
            if not self._wanted.wait(_LOOK_S):
                continue
            try:
                self._show()
            except ShmmapError as error:
                self._say(f"~/around waits: {error}")
                self._ended.wait(_RETRY_S)

    def _place(self, frame_id: str) -> Place | None:
        """Return where the vehicle is: by the last pose, if there are poses, else by transforms."""
        base = self._parameters["base_frame"]
        pose, place = self._pose, self._frames.origin_of(base, frame_id)
        if pose is not None and (pose.header.frame_id or frame_id) == frame_id:
            return pose.pose.position.x, pose.pose.position.y, pose.pose.position.z
        if place is None and pose is not None:
            self._say(f"~/pose is in frame {pose.header.frame_id}, the map in {frame_id}: not used")
        elif place is None:
            self._say(f"~/around waits for a transform from {frame_id} to {base}, or ~/pose")
        return place

    def _show(self) -> None:
        """Publish what changes, until there is no subscriber."""
        radius, edge = self._parameters["around.radius"], self._parameters["around.leaf_size"]
        shown: Mapping[Any, int] = {}
        drawn: Mapping[str, str] | None = None
        with MapWindow(
            self._parameters["endpoint"] or None,
            radius,
            layers=f"voxel(leaf={edge!r})" if edge else "points",
            update_distance=_EVERY_M,
            name=f"{NAME} ~/around",
        ) as window:
            frame_id = self._parameters["frame_id"] or window.client.frame_id
            whole_s = time.monotonic()
            while self._wanted.is_set() and not self._ended.wait(_TICK_S):
                self._read()
                place = self._place(frame_id)
                if place is None:
                    whole_s = time.monotonic()
                    continue
                update = window.move_to(*place[:2])
                if window.complete or window.stale_since is not None:
                    whole_s = time.monotonic()
                versions = window.versions()
                is_due = window.complete or time.monotonic() > whole_s + _INCOMPLETE_S
                if is_due and versions != shown:
                    message = joined_message(window.cells, frame_id)
                    message.header.stamp = self._node.get_clock().now().to_msg()
                    self._publish(self._points, message)
                    shown, whole_s = versions, time.monotonic()
                states = {
                    **dict.fromkeys((cell.id for cell in window.cells), "attached"),
                    **dict.fromkeys((one.cell_id for one in update.failed), "failed"),
                    **dict.fromkeys((one.id for one in update.pending), "loading"),
                }
                if states != drawn and self._boxes.get_subscription_count():
                    heights = {cell.id: cell.z_bounds for cell in window.cells if cell.points}
                    message = boxes_message(self._cells(), states, heights, place, radius)
                    for marker in message.markers:
                        marker.header.frame_id = frame_id
                    self._publish(self._boxes, message)
                    drawn = states


def joined_message(cells: Sequence[Cell], frame_id: str) -> PointCloud2:
    """Return all points of cells as one message, in the map's frame.

    Its fields are those of the first cell with points; the nearest cells first that fit into a message.
    """
    some = [cell for cell in cells if cell.points]
    layout = cloud_layout({"xyz": some[0].xyz, **some[0].columns} if some else {})
    counts = np.cumsum([0, *(cell.points for cell in some)])
    fit = int(np.searchsorted(counts * layout.point_step, MAX_BYTES - 4096, side="right")) - 1
    some = some[:fit]
    data = array("B", bytes(int(counts[len(some)]) * layout.point_step))
    with memoryview(data) as rows:
        for cell, begin, end in zip(some, counts.tolist(), counts[1:].tolist(), strict=False):
            fill_rows(
                rows[begin * layout.point_step : end * layout.point_step], cell.columns, cell.origin, layout
            )
    return cloud_message(layout, int(counts[len(some)]), data, frame_id)


def boxes_message(
    cells: Iterable[CellInfo],
    states: Mapping[str, str],
    heights: Mapping[str, tuple[float, float]],
    place: Place,
    radius: float,
) -> MarkerArray:
    """Return the boxes of cells near a place as lines, a marker with its own namespace for each state.

    Parameters
    ----------
    cells
        The map's cells.
    states
        State by cell id; the other cells are ``not attached``.
    heights
        Lowest and highest point by cell id, where known; other boxes are flat, at the place's height.
    place, radius
        Metres, map frame: cells within four radii of it, ten thousand at most.
    """
    lines: defaultdict[str, list[Point]] = defaultdict(list)
    x, y, z = place
    near = radius * _BOXES_WITHIN
    inside = (
        cell
        for cell in cells
        if cell.box[0] <= x + near
        and cell.box[2] >= x - near
        and cell.box[1] <= y + near
        and cell.box[3] >= y - near
    )
    for cell in islice(inside, _MAX_BOXES):
        low, high = heights.get(cell.id, (z, z))
        add_box(lines[states.get(cell.id, "not attached")], (*cell.box[:2], low), (*cell.box[2:], high))
    return line_markers(lines, _COLOURS)

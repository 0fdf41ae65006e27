# SPDX-License-Identifier: Apache-2.0
"""`MapLoader`: the node ``pointcloud_map_loader`` of a ROS 2 system, with the daemon's map behind it.

One thread has all of ROS: the executor, which never waits for the daemon.  A service's callback is a
coroutine, whose result comes from the threads of `Requests`.  Others follow the daemon's events and its map,
and make the whole map, where that is wanted.
"""

from __future__ import annotations

import contextlib
import ctypes
import signal
import threading
import time
from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import Any, Final

import rclpy
from autoware_map_msgs import msg, srv
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import ParameterDescriptor
from rclpy import callback_groups, clock, exceptions, executors, qos, signals, task
from sensor_msgs.msg import PointCloud2

import shmmap
from shmmap.errors import BadRequest, ConfigError
from shmmap_clients.ros_cells import Answer, Catalogue, CellAnswers, RecentCells, follow_events, joined_cells
from shmmap_clients.ros_node.around import Around
from shmmap_clients.ros_node.live import LiveTopics
from shmmap_clients.ros_node.needs import start_error
from shmmap_clients.ros_node.point_cloud2 import cloud_message, to_point_cloud2
from shmmap_clients.ros_node.requests import Requests
from shmmap_clients.ros_node.settings import NAME, PARAMETERS, REMAPS, checked

_DEPTH: Final = 100
"""Depth of services; with the usual ten, requests that come at once are lost over Fast DDS."""
_LOOK_S: Final = 1.0
_RETRY_S: Final = 30.0
_WARN_S: Final = 60.0
"""How long the diagnostics warn of cells that were left out, seconds."""


def serve(words: Sequence[str], ends: Collection[int]) -> None:
    """Run the node until a signal arrives.

    Parameters
    ----------
    words
        Arguments of ROS, ``--ros-args`` included.
    ends
        The signals, which have to be blocked; at the end they no longer are.

    Raises
    ------
    BadRequest
        ROS refuses its arguments.
    ConfigError
        A parameter has an impossible value.
    CannotStart
        ROS does not start.
    """
    ended = threading.Event()
    with contextlib.suppress(OSError):  # it is not glibc
        # keep what large messages return: each page of the next one would cost a fault
        for option, value in ((-3, 32 << 20), (-1, 256 << 20)):  # M_MMAP_THRESHOLD, M_TRIM_THRESHOLD
            ctypes.CDLL("libc.so.6").mallopt(option, value)
    remaps = [word for old, new in REMAPS.items() for word in ("-r", f"{old}:={new}")]
    try:
        rclpy.init(
            args=[NAME, *words, "--ros-args", *remaps],  # of several rules the first counts
            signal_handler_options=signals.SignalHandlerOptions.NO,
        )
        node = rclpy.create_node("pointcloud_map_loader", namespace="/map")
    except Exception as error:  # rclpy's have no base of their own
        raise start_error(error, NAME) from error
    executor = executors.SingleThreadedExecutor()

    def end() -> None:
        signal.sigwait(ends)
        ended.set()
        executor.create_task(bool)  # which wakes it

    try:
        threading.Thread(target=end, daemon=True).start()
        MapLoader(node, executor, ended)
        while not ended.is_set() and rclpy.ok():
            try:
                executor.spin_once()
            except Exception as error:  # noqa: BLE001, PERF203  as of an answer whose client has left
                node.get_logger().error(f"{type(error).__name__}: {error}")
    finally:
        ended.set()
        signal.pthread_sigmask(signal.SIG_UNBLOCK, ends)
        executor.shutdown(0)
        node.destroy_node()
        rclpy.try_shutdown()


class MapLoader:
    """The node's services, topics and diagnostics.

    Parameters
    ----------
    node, executor
        The node, and the executor that it is added to.
    ended
        Ends the threads.

    Raises
    ------
    ConfigError
        A parameter has an impossible value.
    """

    def __init__(self, node: Any, executor: Any, ended: threading.Event) -> None:
        self._node, self._executor, self._ended, self._log = node, executor, ended, node.get_logger()
        self._parameters = given = {name: _declared(node, name) for name in PARAMETERS}
        self._left_out, self._left_out_s, self._frame_id = 0, float("-inf"), given["frame_id"]
        self._catalogue, self._recent = Catalogue(), RecentCells()
        self._connect = partial(shmmap.connect, given["endpoint"] or None, name=NAME)
        self._requests = Requests(self._connect, given["wait"], self._log.warning, self._log.info)
        executor.add_node(node)
        latched = qos.QoSProfile(depth=1, durability=qos.DurabilityPolicy.TRANSIENT_LOCAL)
        self._metadata = node.create_publisher(
            msg.PointCloudMapMetaData, "output/pointcloud_map_metadata", latched
        )
        self._diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", 1)
        self._wholes = {
            layer: node.create_publisher(PointCloud2, f"output/{topic}", latched)
            for wanted, layer, topic in (
                ("whole", "points", "pointcloud_map"),
                (
                    "downsampled_whole",
                    f"voxel(leaf={given['leaf_size']!r})",
                    "debug/downsampled_pointcloud_map",
                ),
            )
            if given[f"enable_{wanted}_load"]
        }
        self._answers = answers = CellAnswers(self._catalogue, self._recent, plain_ids=given["plain_ids"])
        for name, kind, ask in (
            ("partial", srv.GetPartialPointCloudMap, lambda c, r, last: answers.partial(c, r.area, last)),
            (
                "selected",
                srv.GetSelectedPointCloudMap,
                lambda c, r, last: answers.selected(c, r.cell_ids, last),
            ),
            (
                "differential",
                srv.GetDifferentialPointCloudMap,
                lambda c, r, last: answers.differential(c, r.area, r.cached_ids, last),
            ),
        ):
            if given.get(f"enable_{name}_load", True):
                node.create_service(
                    kind,
                    f"service/get_{name}_pcd_map",
                    partial(self._answered, ask),
                    qos_profile=qos.QoSProfile(depth=_DEPTH),
                    callback_group=callback_groups.ReentrantCallbackGroup(),
                )
        node.create_timer(1.0, self._each_second, clock=clock.Clock(clock_type=clock.ClockType.STEADY_TIME))
        if unused := [name for name, value in given.items() if name.startswith("pcd_") and any(value or ())]:
            self._log.info(f"not used, for the map is the daemon's: {', '.join(unused)}")
        for run in (
            partial(follow_events, given["endpoint"], ended, self._requests.ask_again, name=NAME),
            partial(self._follow_map),
            partial(self._make_wholes),
        ):
            threading.Thread(target=run, daemon=True).start()
        Around(node, executor, ended, given, lambda: self._catalogue.cells.values())
        if given["live"]:
            LiveTopics(node, executor, ended, given, self._connect, self._result)

    async def _answered(
        self, ask: Callable[[shmmap.Client, Any, bool], Answer], request: Any, reply: Any
    ) -> Any:
        """Return the reply, filled once the cells are there."""

        def work(client: shmmap.Client, last: bool) -> tuple[str, Answer, list[Any]]:
            answer = ask(client, request, last)
            cells = [
                msg.PointCloudMapCellWithID(
                    cell_id=name, pointcloud=to_point_cloud2(cell), metadata=_box(cell)
                )
                for name, cell in zip(answer.names, answer.cells, strict=True)
            ]
            return self._frame_id or client.frame_id, answer, cells

        result = await self._result(work)
        if isinstance(result, Exception):
            self._log.error(f"a request is answered with nothing: {result}")
            return reply
        reply.header.frame_id, answer, reply.new_pointcloud_with_ids = result
        if hasattr(reply, "ids_to_remove"):
            reply.ids_to_remove = answer.removed
        if answer.problem:
            self._left_out += len(answer.left_out) + answer.too_large
            self._left_out_s = time.monotonic()
            self._log.error(answer.problem)
        return reply

    async def _result(self, work: Callable[[shmmap.Client, bool], Any]) -> Any:
        """Return what ``work`` returns in a thread of `Requests`, or its error."""
        future = task.Future(executor=self._executor)

        def done(result: Any) -> None:
            future.set_result(result)
            self._executor.wake()

        self._requests.ask(work, done)
        return await future

    def _follow_map(self) -> None:
        """Publish the list of cells whenever it has changed."""
        client: shmmap.Client | None = None
        published: int | None = None
        while not self._ended.is_set():
            try:
                client = client or self._connect()
                self._catalogue.refresh(client)
                self._requests.record(None)
                version = self._catalogue.map_version  # first: the cells may be those of a newer one
                if published != version:
                    message = msg.PointCloudMapMetaData()
                    message.header.frame_id = self._frame_id or client.frame_id
                    message.metadata_list = [
                        msg.PointCloudMapCellMetaDataWithID(
                            cell_id=self._answers.name(cell.id, cell.version), metadata=_box(cell)
                        )
                        for cell in self._catalogue.cells.values()
                    ]
                    self._publish(self._metadata, message)
                    self._log.info(f"a map of {len(message.metadata_list)} cells")
                    published = version
            except shmmap.ShmmapError as error:
                self._requests.record(error)
            self._recent.release_idle()
            self._ended.wait(_LOOK_S)

    def _make_wholes(self) -> None:
        """Publish the whole map, and the downsampled one, if wanted, whenever it has changed."""
        made: dict[str, int | None] = dict.fromkeys(self._wholes)
        while not self._ended.wait(_LOOK_S):
            for layer, publisher in self._wholes.items():
                version, cells = self._catalogue.map_version, self._catalogue.cells.values()
                if version == made[layer]:
                    continue
                try:
                    with self._connect() as client:
                        self._publish(  # keep no reference: it may have 2 GB
                            publisher,
                            cloud_message(
                                *joined_cells(client, cells, layer, wait_s=self._parameters["wait"]),
                                self._frame_id or client.frame_id,
                            ),
                        )
                except shmmap.ShmmapError as error:
                    self._log.error(f"{publisher.topic_name} is not published: {error}")
                    if not isinstance(error, BadRequest):  # that is too large until the map changes
                        self._ended.wait(_RETRY_S)
                        continue
                made[layer] = version

    def _publish(self, publisher: Any, message: Any) -> None:
        """Let the executor publish a message, as of now."""
        message.header.stamp = self._node.get_clock().now().to_msg()
        if not self._ended.is_set():
            self._executor.create_task(publisher.publish, message)

    def _each_second(self) -> None:
        """Publish the node's state; ask again, for not all that ends a wait is an event."""
        self._requests.ask_again()
        status = DiagnosticStatus(name="pointcloud_map_loader: shmmap", message="serves the daemon's map")
        if not self._requests.reachable:
            status.level, status.message = DiagnosticStatus.ERROR, "no daemon answers: requests wait"
        elif time.monotonic() - self._left_out_s < _WARN_S:
            status.level, status.message = DiagnosticStatus.WARN, "cells were left out of answers"
        status.values = [
            KeyValue(key="daemon", value="reachable" if self._requests.reachable else "away"),
            KeyValue(key="cells", value=str(len(self._catalogue.cells))),
            KeyValue(key="requests waiting", value=str(len(self._requests.waiting))),
            KeyValue(key="cells left out", value=str(self._left_out)),
        ]
        self._publish(self._diagnostics, DiagnosticArray(status=[status]))


def _box(cell: shmmap.Cell | shmmap.CellInfo) -> Any:
    return msg.PointCloudMapCellMetaData(
        min_x=cell.box[0], min_y=cell.box[1], max_x=cell.box[2], max_y=cell.box[3]
    )


def _declared(node: Any, name: str) -> Any:
    """Declare a parameter and return its value."""
    default, description = PARAMETERS[name]
    loose = not isinstance(default, bool | str)  # numbers may be whole, and lists be empty
    what = ParameterDescriptor(description=description, read_only=True, dynamic_typing=loose)
    try:
        return checked(name, node.declare_parameter(name, default, what).value)
    except exceptions.ParameterException as error:
        raise ConfigError(f"{error}: {description}", key=name, origin="parameters") from error

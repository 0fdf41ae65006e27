# SPDX-License-Identifier: Apache-2.0
"""Localization as a node of ROS 2: scans of a live topic, guesses of ``/initialpose``, poses and a transform.

A thread has the executor; it keeps the newest cloud, and the newest guess.  The thread that localizes takes
them when it is ready, so that clouds that a newer one followed meanwhile are left out, and counted.
"""

from __future__ import annotations

import signal
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from queue import Empty, SimpleQueue
from types import FrameType, TracebackType
from typing import Any, Final

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from rclpy import executors, qos, signals
from sensor_msgs.msg import PointCloud2
from tf2_msgs.msg import TFMessage

from shmmap import BadRequest, MapDataError
from shmmap_clients.ndt_scan_matcher.drive.follower import Frame
from shmmap_clients.ros_node.needs import start_error
from shmmap_clients.scans.frames import (
    STATIC,
    Matrix,
    MovingFrames,
    StaticFrames,
    frame_name,
    pose_matrix,
    seconds_of,
)
from shmmap_clients.scans.point_cloud2 import scan_of
from shmmap_clients.scans.scan_file import ScanReader
from shmmap_clients.scans.scan_sequence import Scan
from shmmap_clients.scans.trajectory import quaternion_of

GUESSES: Final = "/initialpose"
POSES: Final = "ndt_pose_with_covariance"
"""Relative, as of Autoware's ``ndt_scan_matcher``."""
_COVARIANCE: Final = np.diag([0.0225, 0.0225, 0.0225, 0.000625, 0.000625, 0.000625]).ravel()
"""Of every pose; Autoware's default."""
_ENDS: Final = (signal.SIGINT, signal.SIGTERM)
_SILENT_S: Final = 5.0
_OFF_S: Final = 1.0
_SENT: Final = 1000
_HERE: Final = "the running system"


class RosTopic:
    """The scans of a topic, as they come; used as a context manager in the main thread.

    SIGINT or SIGTERM ends the iteration; a second one has its usual effect.

    Parameters
    ----------
    topic
        Topic of ``sensor_msgs/msg/PointCloud2``.
    reader
        Filter of points, by their range in the scanner's frame; prints notes.
    base_frame, map_frame
        Frame of the vehicle, in which scans are, and of the map.
    odom_frame
        Frame whose transform from the map's is published, once ``/tf`` leads from the vehicle's to it; None:
        no transform is published.
    words
        Arguments of ROS, ``--ros-args`` included.

    Attributes
    ----------
    left_out
        Clouds that were not localized, because a newer one had come.

    Raises
    ------
    BadRequest
        ROS refuses its arguments, or ``odom_frame`` is the vehicle's or the map's.
    CannotStart
        ROS does not start.
    """

    def __init__(
        self,
        topic: str,
        reader: ScanReader,
        *,
        base_frame: str = "base_link",
        map_frame: str = "map",
        odom_frame: str | None = None,
        words: Sequence[str] = (),
    ) -> None:
        if odom_frame in (base_frame, map_frame):
            raise BadRequest(
                f"the transform from {map_frame} to {odom_frame} is not published: {base_frame} would have"
                " two parents where odometry gives it one",
                hint="name the frame of the odometry, such as odom",
            )
        self._reader, self._base, self._map, self._odom = reader, base_frame, map_frame, odom_frame
        self._lock = threading.Lock()  # not for the signals' handler
        self._news: SimpleQueue[None] = SimpleQueue()
        self._cloud: Any = None
        self._guess: Any = None
        self._ended = False
        self._said: set[str] = set()
        self.left_out = 0
        self._static = StaticFrames(_HERE)
        self._moving = MovingFrames(self._static, _HERE)
        self._pose: tuple[Any, Matrix] | None = None  # that the transform is still to be made of
        self._sent: deque[tuple[Any, ...]] = deque(maxlen=_SENT)
        try:
            args = ["shmmap-ndt", *words]
            rclpy.init(args=args, signal_handler_options=signals.SignalHandlerOptions.NO)
            self._node = rclpy.create_node("ndt_scan_matcher")
            subscribe = self._node.create_subscription
            self._clouds = subscribe(PointCloud2, topic, self._on_cloud, qos.qos_profile_sensor_data)
        except Exception as error:  # rclpy's have no base of their own
            rclpy.try_shutdown()
            raise start_error(error, "shmmap-ndt follow") from error
        subscribe(PoseWithCovarianceStamped, GUESSES, self._on_guess, 10)
        latched = qos.QoSProfile(depth=100, durability=qos.DurabilityPolicy.TRANSIENT_LOCAL)
        subscribe(TFMessage, STATIC, self._on_static, latched)
        self._publisher = self._node.create_publisher(PoseWithCovarianceStamped, POSES, 10)
        if odom_frame is not None:
            subscribe(TFMessage, "/tf", self._on_moving, 100)
            self._transforms = self._node.create_publisher(TFMessage, "/tf", 100)
        self._executor = executors.SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin, name="ndt-ros", daemon=True)
        self._handlers: dict[signal.Signals, Any] = {}

    def __enter__(self) -> RosTopic:
        for number in _ENDS:
            self._handlers[number] = signal.signal(number, self._end)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._executor.shutdown()
        self._thread.join()
        self._restore_signals()
        self._node.destroy_node()
        rclpy.try_shutdown()

    def __iter__(self) -> Iterator[Scan]:
        while (cloud := self._next_cloud()) is not None:
            scan = self._scan(cloud)
            if scan is not None:
                self._compare_clocks(scan)
                yield scan

    def wait_guess(self) -> Matrix | None:
        """Wait for a pose of the vehicle on ``/initialpose``; clouds until then are not localized.

        Returns
        -------
        T_map_base, (4, 4); None at the end.
        """
        self._reader.say(f"waiting for a pose on {GUESSES}")
        while not self._ended:
            T = self.take_guess()
            if T is not None:
                with self._lock:
                    self._cloud, self.left_out = None, 0
                return T
            with self._lock:
                frame = None if self._cloud is None else frame_name(self._cloud.header.frame_id)
                is_usable = frame is not None and self._static.find(self._base, frame) is not None
            if is_usable:
                self._say_once("comes", f"scans of {self._clouds.topic_name} come in frame {frame!r}")
            self._wait(frame is None)
        return None

    def take_guess(self) -> Matrix | None:
        """Return T_map_base of a guess that has come since the last call, (4, 4); else None."""
        with self._lock:
            message, self._guess = self._guess, None
        if message is None:
            return None
        pose, frame = message.pose.pose, frame_name(message.header.frame_id)
        if frame != self._map:
            self._reader.say(f"a pose on {GUESSES} is in frame {frame!r}, not {self._map!r}: not taken")
            return None
        try:
            T = pose_matrix(pose.position, pose.orientation, GUESSES)
        except MapDataError as error:
            self._reader.say(f"{error}: not taken")
            return None
        x, y, z = T[:3, 3]
        self._reader.say(f"localizes from the pose on {GUESSES}: ({x:.2f}, {y:.2f}, {z:.2f})")
        return T

    def publish(self, frame: Frame) -> None:
        """Publish the pose of a scan, and the transform, if it is trusted."""
        if not frame.result.trustworthy:
            return
        message = PoseWithCovarianceStamped()
        stamp = message.header.stamp
        stamp.sec, stamp.nanosec = map(int, frame.name.split("."))  # the scan's, to the nanosecond
        message.header.frame_id = self._map
        _fill(frame.result.T_map_base, message.pose.pose.position, message.pose.pose.orientation)
        message.pose.covariance = _COVARIANCE
        self._publisher.publish(message)
        with self._lock:
            if self._odom is None:
                return
            if not self._moving.leads(self._odom, self._base):
                self._say_once(
                    "no chain",
                    f"no transform is published: /tf does not lead from {self._base} to {self._odom}",
                )
            self._pose = stamp, frame.result.T_map_base
            self._send_transform()

    def _spin(self) -> None:
        with suppress(executors.ExternalShutdownException):
            self._executor.spin()

    def _end(self, _number: int, _frame: FrameType | None) -> None:
        self._restore_signals()
        self._ended = True
        self._news.put(None)

    def _restore_signals(self) -> None:
        while self._handlers:
            signal.signal(*self._handlers.popitem())

    def _on_cloud(self, cloud: Any) -> None:
        with self._lock:
            self.left_out += self._cloud is not None
            self._cloud = cloud
        self._news.put(None)

    def _on_guess(self, message: Any) -> None:
        with self._lock:
            self._guess = message
        self._news.put(None)

    def _on_static(self, message: Any) -> None:
        with self._lock:
            self._static.add(message.transforms)
            self._look_for_others(message.transforms)

    def _on_moving(self, message: Any) -> None:
        with self._lock:
            self._look_for_others(message.transforms)
            self._moving.add(message.transforms)
            self._send_transform()

    def _look_for_others(self, transforms: Sequence[Any]) -> None:
        """Stop publishing the transform if another node gives a parent to the frame of the odometry."""
        for one in transforms:
            if frame_name(one.child_frame_id) == self._odom and _key(one) not in self._sent:
                parent = frame_name(one.header.frame_id)
                self._reader.say(
                    f"another node publishes the transform from {parent} to {self._odom}: from now on none is"
                    " published here"
                )
                self._odom = None

    def _send_transform(self) -> None:
        """Publish the transform of the last pose once ``/tf`` has reached its time."""
        if self._odom is None or self._pose is None:
            return
        stamp, T_map_base = self._pose
        try:
            T_odom_base = self._moving.at(seconds_of(stamp), self._odom, self._base)
        except MapDataError as error:
            self._say_once("transform", f"a transform is not published: {error}")
            return
        if T_odom_base is None:
            return
        self._pose = None
        one = TransformStamped(child_frame_id=self._odom)
        one.header.stamp, one.header.frame_id = stamp, self._map
        _fill(T_map_base @ np.linalg.inv(T_odom_base), one.transform.translation, one.transform.rotation)
        self._sent.append(_key(one))
        self._transforms.publish(TFMessage(transforms=[one]))

    def _next_cloud(self) -> Any:
        """Wait for the newest cloud, and return it; None at the end."""
        while not self._ended:
            with self._lock:
                cloud, self._cloud = self._cloud, None
            if cloud is not None:
                return cloud
            self._wait(True)
        return None

    def _wait(self, silent: bool) -> None:
        """Wait for the next message; without any, say so."""
        if not silent or "silent" in self._said:
            self._news.get()
            return
        try:
            self._news.get(timeout=_SILENT_S)
        except Empty:
            topic = self._clouds.topic_name
            found = [one.topic_type for one in self._node.get_publishers_info_by_topic(topic)]
            self._say_once(
                "silent",
                f"{topic} has been silent for {_SILENT_S:g} s; its publishers: {', '.join(found) or 'none'}",
            )

    def _scan(self, cloud: Any) -> Scan | None:
        """Return the scan of a cloud; None if it cannot be used, which is said."""
        topic, frame = self._clouds.topic_name, frame_name(cloud.header.frame_id)
        try:
            with self._lock:
                T = self._static.between(self._base, frame, f"points of {topic} are", frame)
            return scan_of(cloud, topic, self._reader, T)
        except MapDataError as error:
            self._say_once(error.message, f"scans are left out: {error}")
            return None

    def _compare_clocks(self, scan: Scan) -> None:
        now_ns = self._node.get_clock().now().nanoseconds
        off_s = now_ns / 1e9 - scan.stamp_s
        if now_ns and abs(off_s) > _OFF_S:  # 0: no time has come on /clock
            self._say_once(
                "clock",
                f"the time of scan {scan.name} and this node's are {abs(off_s):.9g} s apart; with a bag or a"
                " simulator: --ros-args -p use_sim_time:=true",
            )

    def _say_once(self, what: str, text: str) -> None:
        if what not in self._said:
            self._said.add(what)
            self._reader.say(text)


def _key(transform: Any) -> tuple[Any, ...]:
    """Return what one transform is known by among others."""
    stamp, place = transform.header.stamp, transform.transform.translation
    return transform.header.frame_id, stamp.sec, stamp.nanosec, place.x, place.y, place.z


def _fill(T: Matrix, position: Any, orientation: Any) -> None:
    """Write a pose into the fields of a message."""
    position.x, position.y, position.z = map(float, T[:3, 3])
    q = quaternion_of(T[:3, :3])
    orientation.x, orientation.y, orientation.z, orientation.w = map(float, q)

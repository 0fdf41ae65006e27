# SPDX-License-Identifier: Apache-2.0
"""Poses over ZeroMQ, one msgpack message each: poses that localization publishes, and odometry it receives.

A message is ``{"shmmap_pose": 1, "name", "stamp_s", "T" (16 numbers, rows of T_map_base), "converged",
"trustworthy", "iterations", "transform_probability", "nvtl", "no_map", "state", "failed_limits"}``, the last
three as in `frame_document`; of odometry only ``stamp_s`` and ``T`` are read.

The sender binds, and can wait for a subscriber before the first message.  This subscriber then misses no
message as long as it is less than 1000 messages behind.
"""

from __future__ import annotations

import math
import threading

import msgspec
import numpy as np

from shmmap import BadRequest
from shmmap_clients.ndt_scan_matcher.drive.follower import Frame
from shmmap_clients.scans.trajectory import Trajectory, pose_of
from shmmap_clients.streams import Publisher, Subscriber

_VERSION = 1
_QUEUE = 1000  # messages queued for a slow reader; further messages are dropped
_LINGER_MS = 2000
_POLL_MS = 100
_RESTARTED_S = 1.0  # a larger step back is a restart, not a reordered message
_KEPT = 1000  # odometry entries: ten seconds at 100 Hz


class PoseMessage(msgspec.Struct):
    """One pose."""

    stamp_s: float
    T: list[float]
    shmmap_pose: int = _VERSION
    name: str = ""
    converged: bool = True
    trustworthy: bool = True
    iterations: int = 0
    transform_probability: float = 0.0
    nvtl: float = 0.0
    no_map: bool = False
    state: str = ""
    failed_limits: list[str] = []


_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(PoseMessage)


def decode_pose(message: bytes) -> PoseMessage:
    """Return the pose of a message.

    Raises
    ------
    BadRequest
        The message is not a pose.
    """
    try:
        pose = _decoder.decode(message)
        if pose.shmmap_pose != _VERSION:
            raise BadRequest(f"version {pose.shmmap_pose}, not {_VERSION}")
        if not math.isfinite(pose.stamp_s):
            raise BadRequest("a time that is not finite")
        pose_of(pose.T)
    except (msgspec.DecodeError, BadRequest) as error:
        raise BadRequest(f"a message that is no pose: {error}") from None
    return pose


class PosePublisher(Publisher):
    """Publisher that binds an endpoint and sends a message per scan.

    Raises
    ------
    BadRequest
        The address cannot be bound.
    """

    def __init__(self, endpoint: str) -> None:
        super().__init__(endpoint, queue=_QUEUE, linger_ms=_LINGER_MS)

    def send(self, frame: Frame) -> None:
        """Publish a frame's pose."""
        result = frame.result
        message = PoseMessage(
            frame.stamp_s,
            [float(value) for value in result.T_map_base.ravel()],
            name=frame.name,
            converged=result.converged,
            trustworthy=result.trustworthy,
            iterations=result.iterations,
            transform_probability=result.transform_probability,
            nvtl=result.nvtl,
            no_map=result.no_map,
            state=frame.state,
            failed_limits=list(result.failed_limits),
        )
        self.publish([_encoder.encode(message)])


class OdometrySubscriber:
    """Subscriber that collects odometry from an endpoint in its own thread.

    Raises
    ------
    BadRequest
        The address is invalid.
    """

    def __init__(self, endpoint: str) -> None:
        self._subscriber = Subscriber(endpoint, queue=_QUEUE)
        self._entries: list[PoseMessage] = []
        self._latest_s = -math.inf
        self._closing = threading.Event()
        self._arrived = threading.Condition()
        self._thread = threading.Thread(target=self._receive, name="ndt-odometry", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the subscription."""
        self._closing.set()
        self._thread.join()
        self._subscriber.close()

    def wait_until(self, stamp_s: float, timeout_s: float) -> bool:
        """Wait for odometry of this time or later; return False on timeout."""
        with self._arrived:
            return self._arrived.wait_for(lambda: self._latest_s >= stamp_s, timeout_s)

    @property
    def trajectory(self) -> Trajectory:
        """The odometry received so far, ordered by time."""
        with self._arrived:
            entries = sorted(self._entries, key=lambda entry: entry.stamp_s)
        poses = np.array([entry.T for entry in entries]).reshape(-1, 4, 4)
        return Trajectory(np.array([entry.stamp_s for entry in entries]), poses)

    def _receive(self) -> None:
        while not self._closing.is_set():
            if self._subscriber.poll(_POLL_MS):
                try:
                    entry = decode_pose(self._subscriber.receive()[0])
                except BadRequest:
                    continue  # a message of another program
                self._take(entry)

    def _take(self, entry: PoseMessage) -> None:
        with self._arrived:
            if entry.stamp_s < self._latest_s - _RESTARTED_S:
                self._entries.clear()  # the sender's clock was set back, or the sender restarted
                self._latest_s = -math.inf
            self._entries.append(entry)
            del self._entries[:-_KEPT]
            self._latest_s = max(self._latest_s, entry.stamp_s)
            self._arrived.notify_all()

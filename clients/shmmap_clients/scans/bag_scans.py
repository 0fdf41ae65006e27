# SPDX-License-Identifier: Apache-2.0
"""The scans of a bag, in the vehicle's frame, with poses from one of its topics or from a file."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import islice, pairwise
from typing import Any, Final, Literal

import numpy as np

from shmmap import BadRequest, MapDataError
from shmmap.errors import MapMissing
from shmmap_clients.scans.bag import Bag
from shmmap_clients.scans.frames import (
    STATIC,
    Matrix,
    StaticFrames,
    frame_name,
    pose_matrix,
    seconds_of,
    transform_matrix,
)
from shmmap_clients.scans.point_cloud2 import scan_of
from shmmap_clients.scans.scan_file import ScanReader
from shmmap_clients.scans.scan_sequence import Scan
from shmmap_clients.scans.trajectory import Trajectory, interpolate, moved, read_trajectory

_CLOUDS: Final = ("sensor_msgs/msg/PointCloud2",)
_ODOMETRY: Final = "nav_msgs/msg/Odometry"
_POSES: Final = (_ODOMETRY, "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
_TWISTS: Final = ("geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/TwistWithCovarianceStamped")
_TRANSFORMS: Final = "tf2_msgs/msg/TFMessage"
_DYNAMIC: Final = "/tf"
_GAP_S: Final = 1.5  # poses may come once a second
"""Longest time between two poses that a scan's pose is interpolated from."""
_SCANS_A_POSE: Final = (
    10  # scans for each pose of a topic that is taken without being named: not one of goals
)
_SHORTEST_WINDOW_NS: Final = 10**9

PoseAt = Callable[[float], Matrix | None]


@dataclass(frozen=True, slots=True)
class BagOptions:
    """What a program takes from a bag.

    Attributes
    ----------
    topic
        Topic of the clouds; None: the only one.
    base_frame
        Frame of the vehicle, which poses are of.
    map_frame
        Frame of poses that are taken without being named.
    frame
        Frame of the scans: ``base``, or ``sensor`` for those who need to know where rays begin.
    without_pose
        Treatment of scans at whose time there is no pose, if there are poses: ``keep`` them, ``begin``
        with the first that has one, or ``leave_out``.
    poses_option
        Option of the program that names the topic or the file of the poses.
    """

    topic: str | None = None
    base_frame: str = "base_link"
    map_frame: str = "map"
    frame: Literal["base", "sensor"] = "base"
    without_pose: Literal["keep", "begin", "leave_out"] = "leave_out"
    poses_option: str = "--poses"


class BagScans:
    """The scans of a bag, in the order of their recording.

    Parameters
    ----------
    bag
        The bag, which stays open during the iteration.
    options
        What is taken from it.
    reader
        Filter of points, by their range in the scanner's frame.

    Raises
    ------
    BadRequest
        Several topics have clouds, or the named one has not.
    MapMissing
        There are no clouds.
    MapDataError
        The bag is damaged; later, a frame is unknown.
    """

    def __init__(self, bag: Bag, options: BagOptions, reader: ScanReader) -> None:
        self._bag, self._options, self._reader = bag, options, reader
        self._topic = bag.choose(_CLOUDS, options.topic, "--topic")
        self._frames = StaticFrames(bag.path)
        for _, message in bag.messages(STATIC) if STATIC in bag.of_types((_TRANSFORMS,)) else ():
            self._frames.add(message.transforms)
        self._chains: dict[str, Matrix] = {}
        self._pose_at: PoseAt | None = None

    def read_poses(self, named: str | None = None) -> None:
        """Read the poses of `BagOptions.base_frame`, to be interpolated at the time of each scan.

        Parameters
        ----------
        named
            Their topic or file; None: the only topic that has poses in the map's frame, else ``/tf`` if it
            leads to that, else none.

        Raises
        ------
        BadRequest
            Several topics fit, or the named one does not.
        MapMissing
            There is neither such a topic nor such a file.
        MapDataError
            The messages or the file are damaged, or a frame is unknown.
        """
        source, self._pose_at = self._poses(named)
        poses = f"poses from {source}" if source else "without poses"
        self._reader.say(f"scans of {self._bag.path} are from {self._topic}, {poses}")

    def __iter__(self) -> Iterator[Scan]:
        without = self._options.without_pose if self._pose_at is not None else "keep"
        said = False
        for _, cloud in self._bag.messages(self._topic):
            scan = self._scan(cloud)
            T = self._pose_at(scan.stamp_s) if self._pose_at is not None else None
            if T is None and without != "keep":
                if not said:
                    self._reader.say(f"scan {scan.name} has no pose at its time: left out, as others like it")
                    said = True
                continue
            if without == "begin":
                without = "keep"
            if T is not None and self._options.frame == "sensor":
                T = np.asarray(T @ self._to_base(cloud), np.float64)
            yield replace(scan, T_map_sensor=T)

    def at(self, seconds: float) -> Scan:
        """Return the scan recorded nearest to a time since the bag's begin, without its pose.

        Raises
        ------
        BadRequest
            The bag is over before, or begins later.
        """
        bag = self._bag
        lasts_s = (bag.end_ns - bag.begin_ns) / 10**9
        if not 0.0 <= seconds <= lasts_s:
            raise BadRequest(f"{bag.path} lasts {lasts_s:.9g} s: there is no scan at {seconds:g} s")
        wanted_ns = bag.begin_ns + round(seconds * 10**9)
        window_ns = _SHORTEST_WINDOW_NS
        near: list[tuple[int, int, Any]] = []
        while not near:
            low_ns, high_ns = wanted_ns - window_ns, wanted_ns + window_ns
            whole = low_ns <= bag.begin_ns and high_ns >= bag.end_ns
            found = bag.messages(self._topic) if whole else bag.messages(self._topic, low_ns, high_ns + 1)
            near = [(abs(time_ns - wanted_ns), time_ns, cloud) for time_ns, cloud in found]
            window_ns *= 8
        return self._scan(min(near, key=lambda one: one[:2])[2])

    def motion(self, name: str) -> Trajectory:
        """Return odometry from a topic or a file: poses of the vehicle in any fixed frame, ordered by time.

        Raises
        ------
        BadRequest
            The topic has other messages.
        MapMissing
            There is neither such a topic nor such a file.
        MapDataError
            The messages or the file are damaged, or a frame is unknown.
        """
        if name not in self._bag.topics:
            return self._from_file(name, "--odometry")
        if self._bag.choose((*_POSES, *_TWISTS), name, "--odometry") in self._bag.of_types(_TWISTS):
            return self._integrated(name)
        return self._trajectory(name)[1]

    def _scan(self, cloud: Any) -> Scan:
        """Return the scan of a message, without its pose."""
        bag, stamp = self._bag, cloud.header.stamp
        name = f"{stamp.sec}.{stamp.nanosec:09}"
        T = self._to_base(cloud) if self._options.frame == "base" else None
        return scan_of(cloud, f"{bag.path}, {self._topic} at {name} s", self._reader, T)

    def _to_base(self, cloud: Any) -> Matrix:
        frame = frame_name(cloud.header.frame_id)
        if frame not in self._chains:
            self._chains[frame] = self._frames.between(
                self._options.base_frame, frame, f"points of {self._topic} are", frame
            )
        return self._chains[frame]

    def _poses(self, named: str | None) -> tuple[str, PoseAt | None]:
        """Return where poses come from, and the pose at a time."""
        bag, wanted = self._bag, self._options.map_frame
        if named is None:
            enough = bag.topics[self._topic].messages / _SCANS_A_POSE
            fitting = {
                name: frame_name(message.header.frame_id)
                for name in bag.of_types(_POSES)
                if bag.topics[name].messages >= enough
                for _, message in islice(bag.messages(name), 1)
            }
            in_map = [name for name, frame in fitting.items() if frame == wanted]
            if len(in_map) > 1:
                raise BadRequest(
                    f"{bag.path}: several topics have poses in frame {wanted}: {bag.listed(in_map)}",
                    hint=f"choose one: {self._options.poses_option} {in_map[0]}",
                )
            moving = not in_map and _DYNAMIC in bag.of_types((_TRANSFORMS,))
            if moving and (chain := self._chain()) is not None:
                return _DYNAMIC, chain
            if not in_map:
                for name, frame in fitting.items():
                    option = self._options.poses_option
                    self._reader.say(
                        f"poses of {name} are in frame {frame}, not {wanted}: {option} {name} takes them"
                    )
                return "", None
            named = in_map[0]
        if named in bag.of_types((_TRANSFORMS,)):
            chain = self._chain()
            if chain is None:
                raise MapDataError(
                    f"{bag.path}: transforms of {_DYNAMIC} and {STATIC} do not lead from"
                    f" {self._options.base_frame!r} to {wanted!r}"
                )
            return named, chain
        if named in bag.topics:
            bag.choose(_POSES, named, self._options.poses_option)
            frame, trajectory = self._trajectory(named)
            source = f"{named} in frame {frame}"
        else:
            trajectory = self._from_file(named, self._options.poses_option)
            source = named
        return source, lambda stamp_s: interpolate(trajectory, stamp_s, _GAP_S)

    def _from_file(self, name: str, option: str) -> Trajectory:
        if not os.path.exists(name):
            fitting = self._bag.listed(self._bag.of_types((*_POSES, *_TWISTS, _TRANSFORMS)))
            raise MapMissing(
                f"{option}: there is no file {name}, and no such topic in {self._bag.path}",
                hint=f"it has {fitting}",
            )
        trajectory = read_trajectory(name)
        for note in trajectory.notes:
            self._reader.say(note)
        return _ordered([*zip(trajectory.stamps_s.tolist(), trajectory.T_map_sensor, strict=True)])

    def _trajectory(self, topic: str) -> tuple[str, Trajectory]:
        """Return the frame of a topic's poses, and those of the vehicle in it."""
        bag, base = self._bag, self._options.base_frame
        is_odometry = bag.topics[topic].type == _ODOMETRY
        found: list[tuple[float, Matrix]] = []
        frames: dict[tuple[str, str], Matrix] = {}
        for _, message in bag.messages(topic):
            pose = message.pose if hasattr(message.pose, "position") else message.pose.pose
            child = (frame_name(message.child_frame_id) if is_odometry else "") or base
            key = frame_name(message.header.frame_id), child
            if key not in frames:
                frames[key] = self._frames.between(
                    child, base, f"poses of {topic} are of {child!r}; the vehicle is", child
                )
            T = pose_matrix(pose.position, pose.orientation, f"{bag.path}, {topic}")
            found.append((seconds_of(message.header.stamp), T if child == base else T @ frames[key]))
        if len(frames) != 1:
            text = ", ".join(f"{child} in {frame}" for frame, child in frames)
            raise MapDataError(f"{bag.path}: {topic} has poses of several frames: {text}")
        return next(iter(frames))[0], _ordered(found)

    def _integrated(self, topic: str) -> Trajectory:
        """Return the poses that a vehicle's velocities lead to, from its frame at the first of them."""
        bag, base = self._bag, self._options.base_frame
        twists: list[tuple[float, Matrix]] = []
        for _, message in bag.messages(topic):
            twist = message.twist if hasattr(message.twist, "linear") else message.twist.twist
            frame = frame_name(message.header.frame_id)
            if frame != base:
                raise MapDataError(
                    f"{bag.path}: velocities of {topic} are in frame {frame!r}, not {base!r}",
                    hint="give those of the vehicle's frame, or its Odometry",
                )
            v, w = twist.linear, twist.angular
            values = np.array([v.x, v.y, v.z, w.x, w.y, w.z])
            if not np.isfinite(values).all():
                raise MapDataError(f"{bag.path}: a velocity of {topic} is not finite")
            twists.append((seconds_of(message.header.stamp), values))
        twists.sort(key=lambda one: one[0])
        poses = [(twists[0][0], np.eye(4))]
        for (before_s, before), (after_s, after) in pairwise(twists):
            motion = (before + after) / 2 * (after_s - before_s)
            along = moved(np.array([*motion[:3], 0, 0, 0]))
            half_turn = moved(np.array([0, 0, 0, *motion[3:] / 2]))
            poses.append((after_s, np.asarray(poses[-1][1] @ half_turn @ along @ half_turn, np.float64)))
        return _ordered(poses)

    def _chain(self) -> PoseAt | None:
        """Return the vehicle's pose at a time from ``/tf``; None if it does not lead to the map's frame."""
        bag, base, wanted = self._bag, self._options.base_frame, self._options.map_frame
        moving: dict[str, dict[str, list[tuple[float, Any]]]] = {}  # by child, then by parent
        for _, message in bag.messages(_DYNAMIC):
            for one in message.transforms:
                parents = moving.setdefault(frame_name(one.child_frame_id), {})
                entries = parents.setdefault(frame_name(one.header.frame_id), [])
                entries.append((seconds_of(one.header.stamp), one.transform))
        # from the vehicle's frame, or one that is fixed to it, up to the map's
        joints: list[Trajectory | Matrix] = []
        frame = base
        while frame != wanted:
            fixed = self._frames.find(wanted, frame)
            if fixed is not None:
                joints.append(fixed)
                break
            links = ((one, self._frames.find(one, frame)) for one in moving)
            child, T = next(((one, T) for one, T in links if T is not None), ("", None))
            if T is None:
                return None
            (frame, entries), *others = moving.pop(child).items()
            if others:
                raise MapDataError(
                    f"{bag.path}: in {_DYNAMIC}, {child!r} is in {frame!r} and in {others[0][0]!r}"
                )
            steps = [
                (stamp_s, transform_matrix(transform, f"{bag.path}, {_DYNAMIC}"))
                for stamp_s, transform in entries
            ]
            joints += [T, _ordered(steps)]

        def at(stamp_s: float) -> Matrix | None:
            T = np.eye(4)
            for joint in joints:
                step = interpolate(joint, stamp_s, _GAP_S) if isinstance(joint, Trajectory) else joint
                if step is None:
                    return None
                T = step @ T
            return T

        return at


def scan_at(path: str, seconds: float, options: BagOptions, reader: ScanReader) -> Scan:
    """Return one scan of a bag: see `BagScans.at`, and its errors."""
    with Bag(path) as bag:
        return BagScans(bag, options, reader).at(seconds)


def _ordered(entries: list[tuple[float, Matrix]]) -> Trajectory:
    """Return poses by time, of several at the same time the first."""
    stamps = np.array([stamp_s for stamp_s, _ in entries])
    stamps, rows = np.unique(stamps, return_index=True)
    return Trajectory(stamps, np.array([entries[row][1] for row in rows]).reshape(-1, 4, 4))

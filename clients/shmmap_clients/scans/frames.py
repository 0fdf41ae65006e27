# SPDX-License-Identifier: Apache-2.0
"""Frames, poses and times of ROS messages, of whichever package their classes are."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest, MapDataError
from shmmap_clients.scans.trajectory import Trajectory, interpolate, matrix_of

STATIC: Final = "/tf_static"
_KEPT: Final = 512  # transforms of a frame: five seconds at 100 Hz
_MAX_FRAMES: Final = 4096
_MAX_STEPS: Final = 64
_GAP_S: Final = 1.5
_RESTARTED_S: Final = 1.0  # a larger step back is a restart, not a message out of order

Matrix = NDArray[np.float64]


class StaticFrames:
    """The tree of ``/tf_static``.

    Parameters
    ----------
    where
        Where its messages come from, for errors.
    """

    def __init__(self, where: str) -> None:
        self._where = where
        self._parents: dict[str, tuple[str, Any]] = {}

    def add(self, transforms: Iterable[Any]) -> None:
        """Take transforms, ``geometry_msgs/TransformStamped``; the last one of a frame counts."""
        for one in transforms:
            self._parents[frame_name(one.child_frame_id)] = frame_name(one.header.frame_id), one.transform

    def find(self, target: str, source: str) -> Matrix | None:
        """Return ``T_target_source``; None if no chain leads from one to the other.

        Raises
        ------
        MapDataError
            A transform is none.
        """
        to_source, to_target = self._up(source), self._up(target)
        for frame, T in to_source.items():
            if frame in to_target:
                return T if frame == target else np.asarray(np.linalg.inv(to_target[frame]) @ T, np.float64)
        return None

    def between(self, target: str, source: str, what: str, other: str) -> Matrix:
        """Return ``T_target_source``.

        Parameters
        ----------
        target, source
            The frames.
        what, other
            Beginning of the error, up to "in frame"; and the frame that its hint names.

        Raises
        ------
        MapDataError
            No chain of static transforms leads from one frame to the other.
        """
        T = self.find(target, source)
        if T is None:
            known = sorted({*self._parents} | {parent for parent, _ in self._parents.values()})
            raise MapDataError(
                f"{self._where}: {what} in frame {source!r}, and no chain of transforms of {STATIC} leads"
                f" from it to {target!r}; it has {', '.join(known) or 'none'}",
                hint=f"--base-frame {other} would need no chain for these",
            )
        return T

    def parent_name(self, frame: str) -> str | None:
        """Return a frame's parent; None for a root."""
        return self._parents[frame][0] if frame in self._parents else None

    def parent(self, frame: str) -> tuple[str, Matrix] | None:
        """Return a frame's parent and ``T_parent_frame``; None for a root."""
        if frame not in self._parents:
            return None
        parent, transform = self._parents[frame]
        return parent, transform_matrix(transform, f"{self._where}, {STATIC}")

    def _up(self, frame: str) -> dict[str, Matrix]:
        """Return ``T_ancestor_frame`` for the frame and each of its ancestors, nearest first."""
        found = {frame: np.eye(4)}
        while (above := self.parent(frame)) is not None and above[0] not in found:
            parent, T = above
            found[parent] = np.asarray(T @ found[frame], np.float64)
            frame = parent
        return found


class MovingFrames:
    """The last transforms of ``/tf``, above which those of ``/tf_static`` count.

    Parameters
    ----------
    static
        The other transforms.
    where
        Where the messages come from, for errors.
    """

    def __init__(self, static: StaticFrames, where: str) -> None:
        self._static, self._where = static, where
        self._latest: dict[str, deque[tuple[float, str, Any]]] = {}

    def add(self, transforms: Iterable[Any]) -> None:
        """Take transforms, ``geometry_msgs/TransformStamped``."""
        for one in transforms:
            frame, stamp_s = frame_name(one.child_frame_id), seconds_of(one.header.stamp)
            if frame not in self._latest and len(self._latest) >= _MAX_FRAMES:
                continue
            entries = self._latest.setdefault(frame, deque(maxlen=_KEPT))
            if entries and stamp_s < entries[-1][0] - _RESTARTED_S:
                entries.clear()
            if not entries or stamp_s > entries[-1][0]:
                entries.append((stamp_s, frame_name(one.header.frame_id), one.transform))

    def leads(self, target: str, source: str) -> bool:
        """Return whether a chain of transforms leads from a frame up to one of its ancestors."""
        for _ in range(_MAX_STEPS):
            if source == target:
                return True
            entries = self._latest.get(source)
            above = self._static.parent_name(source) or (entries[-1][1] if entries else None)
            if above is None:
                return False
            source = above
        return False

    def at(self, stamp_s: float, target: str, source: str) -> Matrix | None:
        """Return ``T_target_source`` at a time, of a frame and one of its ancestors, interpolated.

        Returns
        -------
        (4, 4); None if no chain leads there, or the transforms of one of its frames do not reach that time.

        Raises
        ------
        MapDataError
            A transform is none.
        """
        T = np.eye(4)
        for _ in range(_MAX_STEPS):
            if source == target:
                return T
            above = self._static.parent(source) or self._moved(source, stamp_s)
            if above is None:
                return None
            source, T = above[0], np.asarray(above[1] @ T, np.float64)
        return None

    def _moved(self, frame: str, stamp_s: float) -> tuple[str, Matrix] | None:
        """Return a frame's parent and ``T_parent_frame`` at a time."""
        entries = list(self._latest.get(frame, ()))
        before = [one for one in entries if one[0] <= stamp_s][-1:]
        after = [one for one in entries if one[0] > stamp_s][:1]
        if not before or (before[0][0] != stamp_s and not after):
            return None
        near = [one for one in before + after if one[1] == before[0][1]]
        poses = [transform_matrix(transform, f"{self._where}, /tf") for *_, transform in near]
        T = interpolate(Trajectory(np.array([one[0] for one in near]), np.array(poses)), stamp_s, _GAP_S)
        return None if T is None else (before[0][1], T)


def frame_name(frame: str) -> str:
    """Return a frame's name without the slash that ROS 1 put before it."""
    return frame.removeprefix("/")


def seconds_of(stamp: Any) -> float:
    """Return the seconds of a message's time."""
    # an exact quotient: the float that reading the same digits gives
    return (int(stamp.sec) * 10**9 + int(stamp.nanosec)) / 10**9


def transform_matrix(transform: Any, where: str) -> Matrix:
    """Return the (4, 4) of a transform; raises as `pose_matrix`."""
    return pose_matrix(transform.translation, transform.rotation, where)


def pose_matrix(position: Any, orientation: Any, where: str) -> Matrix:
    """Return the (4, 4) of a position and a quaternion.

    Raises
    ------
    MapDataError
        It is none; says ``where``.
    """
    q = orientation
    try:
        T = matrix_of((position.x, position.y, position.z), (q.x, q.y, q.z, q.w))
    except BadRequest as error:
        raise MapDataError(f"{where}: {error.message}") from None
    if not np.isfinite(T).all():
        raise MapDataError(f"{where}: a position is not finite")
    return T

# SPDX-License-Identifier: Apache-2.0
"""Where the vehicle is in the map's frame: by transforms between frames (REP-105), or by a pose."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Final

Place = tuple[float, float, float]
"""x, y, z in metres."""

_MAX_FRAMES: Final = 4096
_MAX_STEPS: Final = 64


@dataclass(slots=True)
class Frames:
    """The latest transform of each frame to its parent, as ``tf2_msgs/TFMessage`` brings them."""

    _latest: dict[str, Any] = field(default_factory=dict)

    def add(self, transforms: Any) -> None:
        """Take transforms, ``geometry_msgs/TransformStamped``; the last one of a frame counts."""
        for one in transforms:
            if one.child_frame_id in self._latest or len(self._latest) < _MAX_FRAMES:
                self._latest[one.child_frame_id] = one

    def origin_of(self, frame: str, within: str) -> Place | None:
        """Return where a frame's origin is in another one; None where no transforms lead there."""
        place = (0.0, 0.0, 0.0)
        for _ in range(_MAX_STEPS):
            if frame == within:
                return place if all(map(math.isfinite, place)) else None
            one = self._latest.get(frame)
            if one is None:
                return None
            place = _moved(place, one.transform)
            frame = one.header.frame_id
        return None


def _moved(place: Place, transform: Any) -> Place:
    """Return a place in the parent's frame; the rotation is a unit quaternion."""
    q, t, (x, y, z) = transform.rotation, transform.translation, place
    # v + 2 q x (q x v + w v)
    a, b, c = q.y * z - q.z * y + q.w * x, q.z * x - q.x * z + q.w * y, q.x * y - q.y * x + q.w * z
    return (
        x + 2.0 * (q.y * c - q.z * b) + t.x,
        y + 2.0 * (q.z * a - q.x * c) + t.y,
        z + 2.0 * (q.x * b - q.y * a) + t.z,
    )

# SPDX-License-Identifier: Apache-2.0
"""Which segments to retire first when memory is short: one small interface, two policies.

A policy only orders candidates; pins, waiting requests and the budget are not its business.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np

from shmmap.daemon.records import Resident

__all__ = ["POLICIES", "EvictionPolicy", "by_distance", "by_last_use"]

Pose: TypeAlias = tuple[float, float]
EvictionPolicy: TypeAlias = Callable[[Sequence[Resident], Sequence[Pose]], list[Resident]]
"""Orders segments, the one to retire first in front; given where the clients are (or will be), metres, map
frame."""


def by_last_use(candidates: Sequence[Resident], poses: Sequence[Pose]) -> list[Resident]:
    """Least recently used first."""
    del poses
    return sorted(candidates, key=lambda resident: resident.last_use_s)


def by_distance(candidates: Sequence[Resident], poses: Sequence[Pose]) -> list[Resident]:
    """Farthest from every client first, least recently used among equals.

    The distance to the *nearest* client counts, weighted by the square root of the size relative
    to the median: a large far cell goes before a small one.  Without any pose it is `by_last_use`.
    """
    if not poses or len(candidates) < 2:
        return by_last_use(candidates, poses)
    boxes = np.array([resident.box for resident in candidates])
    x, y = np.array(poses, dtype=np.float64).T[:, :, np.newaxis]
    dx = np.maximum(np.maximum(boxes[:, 0] - x, x - boxes[:, 2]), 0.0)
    dy = np.maximum(np.maximum(boxes[:, 1] - y, y - boxes[:, 3]), 0.0)
    distance = np.hypot(dx, dy).min(axis=0)
    nbytes = np.array([resident.nbytes for resident in candidates], dtype=np.float64)
    weight = np.sqrt(nbytes / np.median(nbytes))
    last_use = np.array([resident.last_use_s for resident in candidates])
    order = np.lexsort((last_use, -distance * weight))
    return [candidates[index] for index in order]


POLICIES: dict[str, EvictionPolicy] = {"distance": by_distance, "lru": by_last_use}

# SPDX-License-Identifier: Apache-2.0
"""Which segments to retire first when memory is short: one small interface, three policies.

A policy scores segments; pins, waiting requests, the budget and when to score anew are not its business.
Whether a segment was asked for, fetched ahead or computed makes no difference: when it will be needed does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from shmmap.daemon.records import Resident
from shmmap.daemon.travel.places import Places, until_needed

__all__ = ["POLICIES", "EvictionPolicy", "by_distance", "by_last_use", "by_time_until_needed", "score_of"]

SOON_S: Final = 30.0
"""Added to the time until something is needed, or no size would matter of what is needed soon."""

EvictionPolicy: TypeAlias = Callable[[Sequence[Resident], Places, float], NDArray[np.float64]]
"""Scores segments, (N,), given where the clients are and will be, and the time: the highest goes first, among
equals the one that was not used longest."""


def by_last_use(candidates: Sequence[Resident], places: Places, now_s: float) -> NDArray[np.float64]:
    """Least recently used first."""
    del places, now_s
    return np.array([-resident.last_use_s for resident in candidates], dtype=np.float64)


def by_distance(candidates: Sequence[Resident], places: Places, now_s: float) -> NDArray[np.float64]:
    """Farthest from every client first.

    The distance to the *nearest* place where a client is or will be counts, weighted by the square root of
    the size: a large far cell goes before a small one.  Without any place it is `by_last_use`.
    """
    if not len(places):
        return by_last_use(candidates, places, now_s)
    boxes = _boxes(candidates)
    x, y = places.T[:2, :, np.newaxis]
    dx = np.maximum(np.maximum(boxes[:, 0] - x, x - boxes[:, 2]), 0.0)
    dy = np.maximum(np.maximum(boxes[:, 1] - y, y - boxes[:, 3]), 0.0)
    return score_of(np.sqrt((dx * dx + dy * dy).min(axis=0)), _sizes(candidates))


def by_time_until_needed(candidates: Sequence[Resident], places: Places, now_s: float) -> NDArray[np.float64]:
    """Needed last first, weighted by the square root of the size.

    Without any place it is `by_last_use`.
    """
    if not len(places):
        return by_last_use(candidates, places, now_s)
    return score_of(until_needed(_boxes(candidates), places, now_s) + SOON_S, _sizes(candidates))


def score_of(far: NDArray[np.float64] | float, nbytes: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """Return the score of cells that are so far away, in time or space, and so large.

    The square root: of the powers tried, this saved most bytes of loading where sizes differ.
    """
    scores: NDArray[np.float64] = np.asarray(far * np.sqrt(nbytes))
    return scores


def _boxes(candidates: Sequence[Resident]) -> NDArray[np.float64]:
    return np.array([resident.box for resident in candidates]).reshape(-1, 4)


def _sizes(candidates: Sequence[Resident]) -> NDArray[np.float64]:
    return np.array([resident.nbytes for resident in candidates], dtype=np.float64)


POLICIES: dict[str, EvictionPolicy] = {
    "time": by_time_until_needed,
    "distance": by_distance,
    "lru": by_last_use,
}

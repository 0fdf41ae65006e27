# SPDX-License-Identifier: Apache-2.0
"""Which segments to retire first when memory is short: one small interface, two policies.

A policy scores segments; pins, waiting requests, the budget and when to score anew are not its business.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from shmmap.daemon.records import Resident
from shmmap.daemon.transport.sessions import SQUARE_M, SQUARES_ORIGIN

__all__ = ["MOST_PLACES", "POLICIES", "EvictionPolicy", "by_distance", "by_last_use", "places_of"]

Places: TypeAlias = NDArray[np.float64]
"""(P, 2): where clients are or will be, metres, map frame."""
EvictionPolicy: TypeAlias = Callable[[Sequence[Resident], Places], NDArray[np.float64]]
"""Scores segments, (N,), given where the clients are or will be: the highest goes first, among equals the
one that was not used longest."""

MOST_PLACES: Final = 128
"""With more of them, those near each other count as one: scoring takes time for each."""


def by_last_use(candidates: Sequence[Resident], places: Places) -> NDArray[np.float64]:
    """Least recently used first."""
    del places
    return np.array([-resident.last_use_s for resident in candidates], dtype=np.float64)


def by_distance(candidates: Sequence[Resident], places: Places) -> NDArray[np.float64]:
    """Farthest from every client first.

    The distance to the *nearest* client counts, weighted by the square root of the size: a large far cell
    goes before a small one.  Without any place it is `by_last_use`.
    """
    if not len(places):
        return by_last_use(candidates, places)
    boxes = np.array([resident.box for resident in candidates]).reshape(-1, 4)
    x, y = places.T[:, :, np.newaxis]
    dx = np.maximum(np.maximum(boxes[:, 0] - x, x - boxes[:, 2]), 0.0)
    dy = np.maximum(np.maximum(boxes[:, 1] - y, y - boxes[:, 3]), 0.0)
    nearest = np.sqrt((dx * dx + dy * dy).min(axis=0))
    nbytes = np.array([resident.nbytes for resident in candidates], dtype=np.float64)
    scores: NDArray[np.float64] = nearest * np.sqrt(nbytes)
    return scores


def places_of(squares: Collection[int]) -> Places:
    """Return the middles of squares (`shmmap.daemon.transport.sessions.Places`), at most `MOST_PLACES`.

    With more, larger squares stand for those in them.
    """
    found = np.fromiter(squares, np.int64, len(squares))
    columns, rows, side = found >> 32, found & 0xFFFFFFFF, 1
    while len(columns) > MOST_PLACES:
        shift = 1 if len(columns) < 16 * MOST_PLACES else 3  # far too many: not all sizes are tried
        columns, rows, side = columns >> shift, rows >> shift, side << shift
        merged = np.sort(columns << 32 | rows)
        merged = merged[np.append(True, merged[1:] != merged[:-1])]  # np.unique takes ten times as long
        columns, rows = merged >> 32, merged & 0xFFFFFFFF
    middles = (np.stack([columns, rows], axis=1) + 0.5) * side
    return (middles - SQUARES_ORIGIN) * SQUARE_M


POLICIES: dict[str, EvictionPolicy] = {"distance": by_distance, "lru": by_last_use}

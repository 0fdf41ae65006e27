# SPDX-License-Identifier: Apache-2.0
"""What one request for cells asks for."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from shmmap.daemon.cache.ledger import Key
from shmmap.daemon.transport.sessions import Session
from shmmap.geometry import Area, distance_to_boxes

__all__ = ["Wanted"]


@dataclass(eq=False, slots=True)
class Wanted:
    """What one request asks for, and what of it is still outstanding.

    Attributes
    ----------
    cells
        Catalogue index and layer of each handle to send, in reply order.
    removed, removed_packed
        What the client should drop, as the reply says it.
    unknown
        Ids that the map does not have, with the layers asked for.
    refused
        What would exceed the session's quota, with code and message.
    held_old
        Ids of cells that the client holds in an older version.
    area
        What was asked about; None for a request by ids.
    keys, outstanding
        What it waits for in all, and the loads of it that have not ended.
    began_s, deadline_s
        When it began to wait and until when; 0 for a request that does not wait.
    """

    session: Session
    request: int
    cells: list[tuple[int, str]]
    removed: tuple[str, ...] = ()
    removed_packed: bytes = b""
    unknown: list[tuple[str, str]] = field(default_factory=list)
    refused: dict[Key, tuple[str, str]] = field(default_factory=dict)
    held_old: set[str] = field(default_factory=set)
    area: Area | None = None
    keys: tuple[Key, ...] = ()
    outstanding: set[Key] = field(default_factory=set)
    began_s: float = 0.0
    deadline_s: float = 0.0

    def distances_m(self, boxes: NDArray[np.float64]) -> NDArray[np.float64]:
        """How far boxes, (N, 4), are from the client, as far as it said where it is.

        Else from the middle of what it asks about; 0 for a request by ids.
        """
        intent = self.session.intent
        if intent is not None:
            return distance_to_boxes(intent.x, intent.y, boxes)
        if self.area is not None:
            return distance_to_boxes(*self.area.center, boxes)
        return np.zeros(len(boxes))

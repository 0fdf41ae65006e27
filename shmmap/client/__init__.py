# SPDX-License-Identifier: Apache-2.0
"""The client library: connect, ask for cells, follow a pose.

Modules that only windows need are imported at the first use of a window.

Third-party packages are imported first, before shmmap's own modules nest.  Python keeps its frames in chunks
of 16 KiB.  Where imports nest so deeply that a loop in them (numpy's has thousands of rounds) runs at the
border of two chunks, Python maps and unmaps memory in every round (30 ms).
"""

from __future__ import annotations

import copyreg
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import msgspec  # noqa: F401
import numpy as np  # noqa: F401
import posix_ipc  # noqa: F401
import zmq  # noqa: F401

from shmmap.client.cell import Cell
from shmmap.client.cell_set import CellSet, PendingLayer
from shmmap.client.client import Client, connect
from shmmap.lazy_imports import lazy_names

if TYPE_CHECKING:
    from shmmap.client.event_stream import EventStream, MissedEvents
    from shmmap.client.map_listing import CellInfo, MapListing
    from shmmap.client.points_around import PointsAround
    from shmmap.client.window.map_window import MapWindow
    from shmmap.client.window.retention import Retention, RetentionCandidate, RetentionPolicy
    from shmmap.client.window.state import WindowUpdate

__all__ = [
    "Cell",
    "CellInfo",
    "CellSet",
    "Client",
    "EventStream",
    "MapListing",
    "MapWindow",
    "MissedEvents",
    "PendingLayer",
    "PointsAround",
    "Retention",
    "RetentionCandidate",
    "RetentionPolicy",
    "WindowUpdate",
    "connect",
]

__getattr__ = lazy_names(__name__)


def _hand_over(cell: Cell) -> tuple[Callable[..., Cell], tuple[Any, ...]]:
    from shmmap.client.handed_over import hand_over

    return hand_over(cell)


copyreg.pickle(Cell, _hand_over)

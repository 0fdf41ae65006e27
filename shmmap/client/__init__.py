# SPDX-License-Identifier: Apache-2.0
"""The client library: connect, ask for cells, follow a pose.

What windows need is loaded when it is first used; a program that only asks does without.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any, Final

from shmmap.client.cell import Cell
from shmmap.client.cell_set import CellSet, PendingLayer
from shmmap.client.client import Client, connect

if TYPE_CHECKING:
    from shmmap.client.event_stream import EventStream, Missed
    from shmmap.client.map_listing import CellInfo, MapListing
    from shmmap.client.points_around import PointsAround
    from shmmap.client.retention import Departed, Retention, RetentionPolicy
    from shmmap.client.window import MapWindow
    from shmmap.client.window_state import WindowUpdate

__all__ = [
    "Cell",
    "CellInfo",
    "CellSet",
    "Client",
    "Departed",
    "EventStream",
    "MapListing",
    "MapWindow",
    "Missed",
    "PendingLayer",
    "PointsAround",
    "Retention",
    "RetentionPolicy",
    "WindowUpdate",
    "connect",
]

_LATER: Final = {
    "CellInfo": "map_listing",
    "Departed": "retention",
    "EventStream": "event_stream",
    "MapListing": "map_listing",
    "MapWindow": "window",
    "Missed": "event_stream",
    "PointsAround": "points_around",
    "Retention": "retention",
    "RetentionPolicy": "retention",
    "WindowUpdate": "window_state",
}


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module 'shmmap.client' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"shmmap.client.{_LATER[name]}"), name)
    globals()[name] = value
    return value

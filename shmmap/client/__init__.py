# SPDX-License-Identifier: Apache-2.0
"""The client library: connect, ask for cells, follow a pose."""

from shmmap.client.cell import Cell
from shmmap.client.cell_set import CellSet, PendingLayer
from shmmap.client.client import Client, connect
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
    "MapListing",
    "MapWindow",
    "PendingLayer",
    "PointsAround",
    "Retention",
    "RetentionPolicy",
    "WindowUpdate",
    "connect",
]

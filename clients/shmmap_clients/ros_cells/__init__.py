# SPDX-License-Identifier: Apache-2.0
"""What every node has that serves the map to ROS 2: names of cells, answers, layout of points.

It needs neither ROS nor DDS: a node passes on the fields of a request, and sends what an `Answer` has.
"""

from shmmap_clients.ros_cells.answers import LATER, Answer, CellAnswers, StillLoading
from shmmap_clients.ros_cells.catalogue import Catalogue, RecentCells, cell_name, split_name
from shmmap_clients.ros_cells.events import follow_events
from shmmap_clients.ros_cells.point_cloud import MAX_BYTES, CloudLayout, cloud_layout, fill_rows, joined_cells

__all__ = [
    "LATER",
    "MAX_BYTES",
    "Answer",
    "Catalogue",
    "CellAnswers",
    "CloudLayout",
    "RecentCells",
    "StillLoading",
    "cell_name",
    "cloud_layout",
    "fill_rows",
    "follow_events",
    "joined_cells",
    "split_name",
]

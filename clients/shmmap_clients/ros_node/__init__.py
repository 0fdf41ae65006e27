# SPDX-License-Identifier: Apache-2.0
"""Serves the daemon's map as a node of ROS 2, over any RMW, in place of Autoware's map loader."""

from __future__ import annotations

TYPE_CHECKING = False  # that of `typing` takes 10 ms to import, before the program can take signals in hand
if TYPE_CHECKING:
    from shmmap_clients.ros_node.point_cloud2 import to_point_cloud2

__all__ = ["to_point_cloud2"]


def __getattr__(name: str) -> object:
    from shmmap.lazy_imports import lazy_names

    return lazy_names(__name__)(name)

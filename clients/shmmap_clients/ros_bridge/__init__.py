# SPDX-License-Identifier: Apache-2.0
"""Serves the daemon's map to unmodified ROS 2 nodes, in place of Autoware's map loader."""

from __future__ import annotations

from typing import TYPE_CHECKING

from shmmap.lazy_imports import lazy_names

if TYPE_CHECKING:
    from shmmap_clients.ros_bridge.node import BridgeSettings, RosBridge

__all__ = ["BridgeSettings", "RosBridge"]

__getattr__ = lazy_names(__name__)

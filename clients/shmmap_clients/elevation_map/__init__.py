# SPDX-License-Identifier: Apache-2.0
"""Heights of the ground: of a whole map, in the memory of one cell, and around a moving vehicle."""

from __future__ import annotations

from typing import TYPE_CHECKING

from shmmap.lazy_imports import lazy_names

if TYPE_CHECKING:
    from shmmap_clients.elevation_map.build import build_elevation_map
    from shmmap_clients.elevation_map.grid import ElevationGrid
    from shmmap_clients.elevation_map.heights import ElevationRule, WindowHeights

__all__ = [
    "ElevationGrid",
    "ElevationRule",
    "WindowHeights",
    "build_elevation_map",
]

__getattr__ = lazy_names(__name__)

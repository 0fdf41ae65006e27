# SPDX-License-Identifier: Apache-2.0
"""The height of the ground over a whole map, in the memory of one cell; and around a moving vehicle."""

from shmmap_clients.elevation_map.build import build_elevation_map as build_elevation_map
from shmmap_clients.elevation_map.grid import ElevationGrid as ElevationGrid
from shmmap_clients.elevation_map.rule import ElevationRule as ElevationRule
from shmmap_clients.elevation_map.window_heights import WindowHeights as WindowHeights

__all__ = ["ElevationGrid", "ElevationRule", "WindowHeights", "build_elevation_map"]

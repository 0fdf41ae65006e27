# SPDX-License-Identifier: Apache-2.0
"""Names and parameters of the node: Autoware's, and some of its own."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

from shmmap.errors import ConfigError

NAME: Final = "shmmap-ros-node"
REMAPS: Final = {
    "service/get_partial_pcd_map": "get_partial_pointcloud_map",
    "service/get_differential_pcd_map": "get_differential_pointcloud_map",
    "service/get_selected_pcd_map": "get_selected_pointcloud_map",
    "output/pointcloud_map": "pointcloud_map",
    "output/pointcloud_map_metadata": "pointcloud_map_metadata",
    "output/debug/downsampled_pointcloud_map": "debug/downsampled_pointcloud_map",
}
"""Names in the namespace, for those of Autoware's map loader, where the command line has no others."""
PARAMETERS: Final[Mapping[str, tuple[Any, str]]] = {
    "enable_whole_load": (False, "publish all points of the map"),
    "enable_downsampled_whole_load": (False, "publish the map with a point in each voxel of leaf_size"),
    "enable_partial_load": (True, "serve cells of an area; the differential service is always there"),
    "enable_selected_load": (False, "serve cells by id"),
    "leaf_size": (3.0, "edge of the voxels of the downsampled map, metres"),
    "pcd_paths_or_directory": ([""], "not used: the map is the daemon's"),
    "pcd_metadata_path": ("", "not used: the map is the daemon's"),
    "frame_id": ("", "frame of the map; empty: as the daemon says"),
    "endpoint": ("", "the daemon's socket, or its instance's name; empty: where it usually is"),
    "wait": (30.0, "seconds that a request's cells may load; then those that are there are sent"),
    "base_frame": ("base_link", "the vehicle's frame in /tf; ~/pose gives its place without /tf"),
    "around.radius": (100.0, "~/around: radius of what is shown of the map, metres"),
    "around.leaf_size": (0.5, "~/around: edge of its voxels, metres; 0: all points"),
    "live": ("", "a live map to show below /shmmap/live, and from above as ~/projected_map"),
    "projected_map.min_z": (0.2, "~/projected_map: lowest voxels, metres in the map's frame"),
    "projected_map.max_z": (2.0, "~/projected_map: highest voxels, metres in the map's frame"),
    "plain_ids": (False, "ids without versions, as Autoware's; a changed cell is then not sent again"),
}
"""Parameters with defaults and descriptions; they can be set at the start alone."""
_LOWEST: Final = {
    "wait": 0.0,
    "leaf_size": 1e-3,
    "around.radius": 1.0,
    "around.leaf_size": 0.0,
    "projected_map.min_z": -math.inf,
    "projected_map.max_z": -math.inf,
}


def checked(name: str, value: Any) -> Any:
    """Return the value of a parameter; a number as float.

    Raises
    ------
    ConfigError
        It is no number, or an impossible one.
    """
    lowest = _LOWEST.get(name)
    if lowest is None:
        return value
    if type(value) in (int, float) and lowest <= value < math.inf:
        return float(value)
    raise ConfigError(
        f"parameter {name}: expected a number, {lowest:g} or more, not {value!r}",
        key=name,
        origin="parameters",
    )

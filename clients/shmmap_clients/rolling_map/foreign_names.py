# SPDX-License-Identifier: Apache-2.0
"""Names of Rolling-Bonxai's version 2, and what version 1 calls the same."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

__all__ = ["VERSION_2", "is_version_2", "version_2_advice"]

VERSION_2: Final = {
    "frame_id": "map_frame",
    "base_frame_id": "robot_frame",
    "topic_in": "",
    "resolution": "m_resolution",
    "occupancy_min_z": "s_min_z",
    "occupancy_max_z": "s_max_z",
    "occupancy_threshold": "",
    "occupancy.resolution": "m_resolution",
    "occupancy.occupancy_min_z": "s_min_z",
    "occupancy.occupancy_max_z": "s_max_z",
    "occupancy.occupancy_threshold": "",
    "sensor_model.max_range": "s_max_range",
    "sensor_model.hit": "s_probability_hit",
    "sensor_model.miss": "s_probability_miss",
    "sensor_model.min": "m_occupancy_min_thresh",
    "sensor_model.max": "m_occupancy_max_thresh",
    "rolling.coordinate_system.chunk_size": "c_chunk_dim",
    "rolling.storage.full_save_folder_path": "c_chunk_folder_path",
    "stats.publish_occupied_voxels": "viz_occupied",
    "stats.enable_stats": "viz_usage",
    "stats.quick_stats": "viz_usage",
}
"""By the name in version 2 (without dots: of its server that does not roll), that in version 1, if any."""

_HERE: Final = {
    "topic_in": "give --scans",
    "occupancy_threshold": "occupied_above in [live.NAME] of the daemon's settings",
    "occupancy.occupancy_threshold": "occupied_above in [live.NAME] of the daemon's settings",
    "rolling.transition_manager.hysteresis_ratio": "hysteresis in [live.NAME] of the daemon's settings",
    "rolling.loading_policy.neighborhood.radius": "radius in [live.NAME] of the daemon's settings",
    "rolling.loading_policy.neighbourhood.radius": "radius in [live.NAME] of the daemon's settings",
}
"""What does the same here, where version 1 has no name for it."""

_GROUPS: Final = ("occupancy.", "sensor_model.", "rolling.", "server.", "stats.")


def is_version_2(name: str) -> bool:
    """Whether a parameter is one of version 2."""
    return name in VERSION_2 or name.startswith(_GROUPS)


def version_2_advice(names: Iterable[str]) -> str:
    """Return what to write in place of names of version 2."""
    said = []
    for name in names:
        if VERSION_2.get(name):
            said.append(f"{VERSION_2[name]} for {name}")
        else:
            said.append(f"{_HERE[name]} for {name}" if name in _HERE else f"nothing for {name}")
    return "write " + "; ".join(said)

# SPDX-License-Identifier: Apache-2.0
"""Maps scans with poses into a live map of the daemon, as Rolling-Bonxai does, and draws the map."""

from __future__ import annotations

from typing import TYPE_CHECKING

from shmmap.lazy_imports import lazy_names

if TYPE_CHECKING:
    from shmmap_clients.rolling_map.parameters import (
        LiveSettings,
        Parameters,
        Shown,
        live_section,
        read_parameters,
    )
    from shmmap_clients.rolling_map.picture import MapContent, map_picture

__all__ = [
    "LiveSettings",
    "MapContent",
    "Parameters",
    "Shown",
    "live_section",
    "map_picture",
    "read_parameters",
]

__getattr__ = lazy_names(__name__)

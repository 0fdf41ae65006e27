# SPDX-License-Identifier: Apache-2.0
"""Localization of a vehicle from a rough pose (GNSS, a click on a map) and one scan.

::

    from shmmap_clients.pose_initializer import PoseInitializer, RoughPose

    with PoseInitializer(endpoint) as initializer:
        found = initializer.initialize(scan, RoughPose(x, y, yaw=0.3, sigma_m=2.0))
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from shmmap.lazy_imports import lazy_names

if TYPE_CHECKING:
    from shmmap_clients.pose_initializer.candidates import RoughPose
    from shmmap_clients.pose_initializer.initializer import (
        Alternative,
        InitializerRules,
        InitialPose,
        PoseInitializer,
        Relocalizer,
    )

__all__ = ["Alternative", "InitialPose", "InitializerRules", "PoseInitializer", "Relocalizer", "RoughPose"]

__getattr__ = lazy_names(__name__)

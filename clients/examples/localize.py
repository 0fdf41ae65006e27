# SPDX-License-Identifier: Apache-2.0
"""Localize a vehicle end to end: a first pose from a rough one, then scan after scan.

    python3 localize.py SCANS X Y YAW HEIGHT          # a directory; metres and radians, map frame

HEIGHT is that of the scanner above the ground.  `shmmap-ndt follow` does this with odometry, bags, ROS 2
topics, and a search where the vehicle is lost.
"""

from __future__ import annotations

import sys

import numpy as np
from shmmap_clients.ndt_scan_matcher import MapUpdater, NdtMatcher, Settings
from shmmap_clients.pose_initializer import InitializerRules, PoseInitializer, RoughPose
from shmmap_clients.scans import ScanSequence, thinned


def main() -> int:
    """Print the pose of each scan."""
    x, y, yaw, height = map(float, sys.argv[2:6])
    scans = ScanSequence(sys.argv[1])
    rough = RoughPose(x, y, yaw=yaw, sigma_m=2.0, sigma_yaw=0.2)
    with PoseInitializer(rules=InitializerRules(height=height)) as initializer:
        found = initializer.initialize(thinned(next(iter(scans)).xyz, 1.0), rough)
    T_map_base, motion, trusted = found.result.T_map_base, np.eye(4), 0
    with (
        NdtMatcher(Settings(mode="coarse_fine")) as matcher,
        MapUpdater(prepare=matcher.prepare) as maps,  # the map around the vehicle, kept current by a thread
    ):
        for scan in scans:
            guess = T_map_base @ motion  # as the vehicle moved from the scan before to the last one
            matcher.set_map(maps.map_at(guess[0, 3], guess[1, 3]))
            result = matcher.align(thinned(scan.xyz, 1.0), guess)
            print(scan.name, result)
            if result.trustworthy:
                motion, T_map_base = np.linalg.inv(T_map_base) @ result.T_map_base, result.T_map_base
                trusted += 1
            else:
                T_map_base = guess
    print(f"{trusted} of {len(scans)} poses are trusted")
    return 0 if trusted == len(scans) else 1


if __name__ == "__main__":
    sys.exit(main())

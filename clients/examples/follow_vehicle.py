# SPDX-License-Identifier: Apache-2.0
"""Keep the map around a moving vehicle.

    python3 follow_vehicle.py X Y           # metres; start; drives 40 m along x, at 10 m/s

A `MapWindow` holds the cells around a pose in shared memory.  The vehicle's loop passes each pose to it; a
thread of the window requests new cells from the daemon, so that `move_to` never waits.
"""

from __future__ import annotations

import sys
import time

import shmmap

SPEED = 10.0  # m/s
PERIOD_S = 0.02


def drive(window: shmmap.MapWindow, x: float, y: float) -> None:
    """Move along x, and print the cells that are added and removed."""
    window.move_to(x, y, wait=10.0)  # before the start: wait until the daemon has read the first cells
    for step in range(200):
        here = x + SPEED * PERIOD_S * step
        update = window.move_to(here, y, vx=SPEED, vy=0.0)  # the velocity lets the daemon prefetch
        if update.any:
            new, gone = len(update.added), len(update.removed)
            print(f"x {here:.1f} m: {new} cells new, {gone} gone, {len(window.cells)} in the window")
        # While the daemon is away, the window keeps its cells; later it reconnects.
        if window.error is not None:
            print(f"x {here:.1f} m: {window.error}", file=sys.stderr)
        time.sleep(PERIOD_S)
    # Points are read in place; only `gather` copies.
    near = window.points_around(here, y, 20.0)
    print(f"{near.count()} points within 20 m{'' if near.covered else ', and more to come'}")


def main() -> int:
    """Follow the vehicle."""
    x, y = map(float, sys.argv[1:3])
    with shmmap.MapWindow(radius=50.0, layers="points", update_distance=5.0) as window:
        drive(window, x, y)
    return 0


if __name__ == "__main__":
    sys.exit(main())

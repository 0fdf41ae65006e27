# SPDX-License-Identifier: Apache-2.0
"""Record where a client drives, and drive it again: to find the radius and the budget that a vehicle needs.

    python3 record_drive.py record drive.csv NAME [SECONDS]   # a client's name in `shmmap clients`
    python3 record_drive.py replay drive.csv RADIUS

A line of the file has a time in seconds and a place in metres.  The replay prints where the map was late.
"""

from __future__ import annotations

import sys
import time

import numpy as np

import shmmap

PERIOD_S = 0.1


def record(path: str, name: str, seconds: float) -> None:
    """Write the client's place each tenth of a second, as the daemon knows it of the last request."""
    begin_s = time.monotonic()
    with shmmap.connect() as client, open(path, "w", 1, encoding="ascii") as file:
        while (now_s := time.monotonic() - begin_s) < seconds:
            for row in client.stats().sessions:
                if row.client == name and row.pose is not None:
                    file.write(f"{now_s:.3f},{row.pose[0]:.3f},{row.pose[1]:.3f}\n")
            time.sleep(PERIOD_S)


def replay(path: str, radius: float) -> None:
    """Move a window as recorded, in the recorded time."""
    drive = np.loadtxt(path, delimiter=",", ndmin=2)
    late, begin_s = 0, time.monotonic() - drive[0, 0]
    with shmmap.MapWindow(radius=radius) as window:
        window.move_to(drive[0, 1], drive[0, 2], wait=30.0)
        for stamp_s, x, y in drive:
            time.sleep(max(0.0, begin_s + stamp_s - time.monotonic()))
            window.move_to(x, y)
            if not window.points_around(x, y, radius / 2).covered:
                late += 1
                print(f"{stamp_s:.1f} s: at {x:.1f}, {y:.1f} the map is not there yet")
    print(f"{len(drive)} places, {late} of them before their map")


def main() -> int:
    """Record or replay."""
    match sys.argv[1:]:
        case ["record", path, name, *seconds]:
            record(path, name, float(seconds[0]) if seconds else float("inf"))
        case ["replay", path, radius]:
            replay(path, float(radius))
        case _:
            print(__doc__, file=sys.stderr)
            return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())

# SPDX-License-Identifier: Apache-2.0
"""``shmmap demo``, of a small town and two processes: ``python -m tests.support.small_demo``, as the verb.

Everything that the demonstration starts and does, in a few seconds.
"""

from __future__ import annotations

import functools
import sys
from typing import Final

from shmmap import cli
from shmmap.demo import demo_town, live_drive
from shmmap.simulation.lidar import Lidar

__all__ = ["SMALL", "SMALL_LIVE"]

SMALL: Final = demo_town.DemoSettings(
    blocks=(3, 2),
    density=4.0,
    radius=60.0,
    length=20.0,
    onward=12,
    localized=10.0,
    counts=(1, 2),
    many=2,
)

SMALL_LIVE: Final = live_drive.LiveDriveSettings(
    length=420.0,
    step=7.0,
    lidar=Lidar(rings=16, azimuth_deg=1.5, farthest=25.0),
    density=4.0,
    budget_bytes=4 << 20,
)


if __name__ == "__main__":
    demo_town.DemoSettings = functools.partial(  # type: ignore[misc, assignment]
        demo_town.DemoSettings, **{name: getattr(SMALL, name) for name in SMALL.__slots__}
    )
    live_drive.LiveDriveSettings = functools.partial(  # type: ignore[misc, assignment]
        live_drive.LiveDriveSettings, **{name: getattr(SMALL_LIVE, name) for name in SMALL_LIVE.__slots__}
    )
    sys.exit(cli.main(["demo", *sys.argv[1:]]))

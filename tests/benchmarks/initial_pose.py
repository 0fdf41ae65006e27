# SPDX-License-Identifier: Apache-2.0
"""What Autoware waits for at each initial pose: all cells within 50 m, of a map of 250 MB.

    python -m tests.benchmarks.initial_pose [--rounds 6]

The map is divided into cells of 20 m, and one file. The cells come through the bridge to ROS 2, as
Autoware's ``map_height_fitter`` gets them, over CycloneDDS on the loopback interface; the client does not
look into the reply. And as handles, by the Python client of shmmap. Everything is in memory before.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path

import numpy as np

import shmmap
from tests.benchmarks.ros_bridge import SERVICE, raw, timed
from tests.support.bridge_process import BridgeProcess, bridge_environment, dds_domain
from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import make_map, write_pcd

RADIUS_M = 50.0
POINTS = 61_000
"""Points of each of 256 cells, 16 bytes a point."""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=6)
    rounds = parser.parse_args().rounds
    os.environ.update(bridge_environment())
    with tempfile.TemporaryDirectory() as directory:
        divided = make_map(Path(directory) / "map", columns=16, rows=16, points=POINTS)
        measure("divided", divided.root, rounds)
        cells = [divided.points(name) for name in divided.corners]
        one_file = Path(directory) / "map.pcd"
        write_pcd(one_file, {name: np.concatenate([cell[name] for cell in cells]) for name in cells[0]})
        measure("one file", one_file, rounds)


def measure(name: str, map_path: Path, rounds: int) -> None:
    """Measure and print."""
    from shmmap_clients.ros_bridge.messages import PARTIAL, AreaInfo

    from tests.support.ros_peer import ros_peer

    raw(PARTIAL.reply)
    with (
        dds_domain() as domain,
        DaemonProcess(map_path, "--budget", "2G") as daemon,
        BridgeProcess(daemon, domain),
        ros_peer(domain) as peer,
        shmmap.connect(daemon.endpoint) as client,
    ):
        square, area = shmmap.AutowareSquare(0.0, 0.0, RADIUS_M), AreaInfo(0.0, 0.0, RADIUS_M)
        count = len(client.area(square, wait=300.0).raise_for_failures())
        asking = peer.client(SERVICE, PARTIAL)
        nbytes = len(asking.call(area=area).data)
        print(f"{name}: {count} cells, {nbytes:,} bytes in a reply")
        for what, times in (
            ("bridge", timed(lambda: asking.call(area=area), rounds)),
            ("handles", timed(lambda: client.area(square), rounds)),
        ):
            print(f"  {what:8} {min(times):8.1f} to {max(times):8.1f} ms, median {np.median(times):.1f} ms")


if __name__ == "__main__":
    main()

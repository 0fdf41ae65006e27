# SPDX-License-Identifier: Apache-2.0
"""A ROS client as a process of its own: it asks once, says so, and waits; it can be stopped or killed.

python -m tests.support.ros_listener DOMAIN
"""

from __future__ import annotations

import sys

from shmmap_clients.ros_bridge.messages import PARTIAL, AreaInfo

from tests.support.ros_maps import NAMES
from tests.support.ros_peer import ros_peer


def main() -> None:
    """Ask for a few cells, then wait until the standard input ends."""
    with ros_peer(int(sys.argv[1])) as peer:
        client = peer.client(NAMES["partial"], PARTIAL)
        cells = client.call(area=AreaInfo(0.0, 0.0, 5.0)).new_pointcloud_with_ids
        print(len(cells), flush=True)
        sys.stdin.read()


if __name__ == "__main__":
    main()

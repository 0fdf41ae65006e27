# SPDX-License-Identifier: Apache-2.0
"""``python -m shmmap_clients.ros_node`` is ``shmmap-ros-node``."""

import sys

from shmmap_clients.ros_node.cli import main

if __name__ == "__main__":
    sys.exit(main())

# SPDX-License-Identifier: Apache-2.0
"""``python -m shmmap_clients.ros_bridge`` is ``shmmap-ros-bridge``."""

import sys

from shmmap_clients.ros_bridge.cli import main

if __name__ == "__main__":
    sys.exit(main())

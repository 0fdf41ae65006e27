# SPDX-License-Identifier: Apache-2.0
"""``python -m shmmap_clients.elevation_map`` is ``shmmap-elevation``."""

import sys

from shmmap_clients.elevation_map.cli import main

if __name__ == "__main__":
    sys.exit(main())

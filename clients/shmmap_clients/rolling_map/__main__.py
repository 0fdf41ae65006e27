# SPDX-License-Identifier: Apache-2.0
"""``python -m shmmap_clients.rolling_map`` is ``shmmap-rolling``."""

import sys

from shmmap_clients.rolling_map.cli import main

if __name__ == "__main__":
    sys.exit(main())
